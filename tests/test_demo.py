"""`cronos-demo`: its commands."""

from pathlib import Path

from cronos_lerobot.scripts.demo import make_commands


def test_each_command_reads_what_an_earlier_one_makes():
    commands = make_commands("full", Path("out"))
    made = set()
    for command in commands:
        reads = [word for word in command.words[1:] if "out/" in word and str(command.output) not in word]
        assert all(any(str(folder) in word for folder in made) for word in reads), command
        made.add(command.output)
    assert [command.words[0] for command in commands] == [
        "cronos-record-demos",
        "lerobot-train",
        "cronos-eval",
        "cronos-train",
        "cronos-eval",
        "cronos-eval",
        "cronos-report",
    ]


def test_the_quick_demo_begins_with_the_official_base():
    full, quick = (make_commands(scale, Path("out")) for scale in ("full", "quick"))
    assert [command.words[0] for command in quick] == [command.words[0] for command in full[2:]]
    for command in quick[:2]:
        assert "--policy.path=kitchen_2x2_state" in command.words
