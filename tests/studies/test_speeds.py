"""The studies that measure speeds and physics say what they measure: each at its smallest."""

import sys
from types import SimpleNamespace

import numpy as np

from cronos_lerobot.studies import physics_check, reading_speed, recorder_speed, speed


def run(monkeypatch, capsys, study, *flags):
    monkeypatch.setattr(sys, "argv", [study.__name__, *map(str, flags)])
    study.main()
    return capsys.readouterr().out.splitlines()


def test_speeds_are_told_beside_the_bound(monkeypatch, capsys):
    recorded = speed.recorded_actions
    monkeypatch.setattr(speed, "recorded_actions", lambda num_envs, scene: recorded(num_envs, scene, steps=2))
    skipped = ("pixels", "inference", "train")
    lines = run(monkeypatch, capsys, speed, "--num_envs=2", "--seconds=0.01", "--skip", *skipped)
    rates = {line[:28].strip(): line[28:].split() for line in lines if "steps/s" in line}
    assert list(rates) == ["pure physics (bound)", "environment, state", "scripted expert"]
    bound = float(rates["pure physics (bound)"][0])
    for rate, _, ratio in rates.values():
        assert abs(float(rate) / bound - float(ratio)) < 0.02 + 0.1 * float(ratio)


def test_what_is_written_by_all_writers_is_the_same_size_and_is_read(tmp_path, monkeypatch, capsys):
    costs = dict(recorder_speed.compare_writers(1, 32, 32, 4, tmp_path))
    names = [
        "StreamRecorder",
        "StreamRecorder, drawing too",
        "LeRobot, its defaults",
        "LeRobot, streaming, our codec",
    ]
    assert list(costs) == names
    assert {cost.frames for cost in costs.values()} == {4}
    sizes = [cost.num_bytes for cost in costs.values()]
    assert max(sizes) < 1.1 * min(sizes)
    flags = (f"--root={tmp_path / 'ours'}", "--repo_id=benchmark/streams", "--frames=2")
    lines = run(monkeypatch, capsys, reading_speed, *flags)
    assert [line.split()[0] for line in lines] == list(reading_speed.BACKENDS)


def test_physics_are_compared_row_by_row(monkeypatch, capsys):
    record_tape, trials = physics_check.record_tape, physics_check.trials
    monkeypatch.setattr(physics_check, "record_tape", lambda num_streams: record_tape(1, steps=2))
    found = {
        "slip": SimpleNamespace(fast=np.array([0.001, 0.003]), still=np.array([0.0, 0.0])),
        "rest": SimpleNamespace(depth=0.0005, drift=0.002),
        "slide": 0.33,
        "coast": 0.0127,
        "random_actions": SimpleNamespace(
            control_steps=7,
            diverged=0,
            episodes=2,
            lost=1,
            through_table=0,
            tracking_error=0.01,
            worst_tracking=0.1,
        ),
    }
    for name, value in found.items():
        monkeypatch.setattr(trials, name, lambda *_, value=value, **__: value)
    lines = run(monkeypatch, capsys, physics_check, "--quick", "--random_steps=7")
    rows = {cells[1].strip(): cells[2:4] for line in lines if len(cells := line.split("│")) == 5}
    assert [cell.strip() for cell in rows["toy bear: 20 fast steps, median / 95 %, mm"]] == ["2.00 / 2.90"] * 2
    assert [cell.strip() for cell in rows["stacked, depth, mm"]] == ["0.500"] * 2
    assert [cell.strip() for cell in rows["of 2 random episodes, a body lost"]] == ["1"] * 2
    assert rows["control steps per CPU second"][0].strip() not in ("", "0 [0, 0]")
