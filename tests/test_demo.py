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
