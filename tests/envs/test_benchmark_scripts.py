"""The scripts of `benchmarks/` that measure the environment run, each at its smallest."""

import runpy
import sys
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "benchmarks"


def run(monkeypatch, capsys, script, *flags):
    monkeypatch.setattr(sys, "argv", [script, *flags])
    runpy.run_path(str(FOLDER / script), run_name="__main__")
    return capsys.readouterr().out.splitlines()


def test_speeds_are_ratios_to_the_physics(monkeypatch, capsys):
    flags = ("--num_envs=2", "--seconds=0.01", "--steps=2", "--parts", "physics", "state", "expert")
    lines = run(monkeypatch, capsys, "speed.py", *flags)
    rates = {line[:36].strip(): line[36:].split() for line in lines if "steps/s" in line}
    assert list(rates) == ["physics", "environment, state", "scripted expert"]
    bound = float(rates["physics"][0])
    for rate, _, ratio in rates.values():
        assert abs(float(rate) / bound - float(ratio)) < 0.02 + 0.1 * float(ratio)


def test_a_short_hunt_finds_no_cheat(monkeypatch, capsys):
    header, *rows = run(monkeypatch, capsys, "cheat_hunt.py", "--trials=1", "--population=16")
    assert header.split()[:2] == ["pair", "trials"]
    assert len(rows) == 4
    for row in rows:
        trials, paid, unsteady, *_ = map(int, row[45:].split())
        assert (trials, paid, unsteady) == (48, 0, 0)
