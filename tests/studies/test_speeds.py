"""The studies that measure speeds say what they measure: each at its smallest."""

import sys

from cronos_lerobot.studies import reading_speed, recorder_speed, speed


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
