"""The Python examples of docs/streams.md, word for word, on a recording."""

import re
from pathlib import Path

from synthetic_streams import record

from cronos_lerobot.scripts.streams import COMMANDS, FilterConfig

DOCS = (Path(__file__).parents[2] / "docs/streams.md").read_text()


def test_examples_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs/train/recorded").mkdir(parents=True)
    record(tmp_path / "outputs/train/recorded/streams")
    selecting, reading = re.findall(r"```python\n(.*?)```", DOCS, re.DOTALL)
    found: dict = {}
    exec(selecting, found)
    # Twelve of 24 segments succeed, half of them after two updates.
    assert found["late"].num_episodes == 6
    exec(reading, found)
    assert len(found["whole"]["cronos.step"]) == 32
    assert len(found["frames"]) == found["segment"].length == 4
    assert "END_EFFECTOR_RESET 1 False" in capsys.readouterr().out


def test_flags_and_commands_exist():
    flags = set(re.findall(r"`--filter\.(\w+)", DOCS))
    assert flags == set(FilterConfig().filter.__dict__)
    assert set(re.findall(r"cronos-streams (\w+)", DOCS)) == set(COMMANDS)
