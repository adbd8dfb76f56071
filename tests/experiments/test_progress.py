"""How far a run has come, and what is left of it."""

import json

import pytest

from cronos_lerobot.experiments.progress import train_progress

HOUR = 3600


def write_run(folder, times, starts):
    """Records of updates of 100 steps each, at these times [s since the epoch]."""
    records = [
        {"kind": "update", "interaction_steps": 100 * (i + 1), "time": time, "rollout": {"success": 0.25}}
        for i, time in enumerate(times)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    (folder / "manifest.json").write_text(json.dumps({"starts": [{"time": start} for start in starts]}))


@pytest.mark.parametrize(
    ("times", "starts", "left"),
    [
        # 10 s an update, 5 of 10 to go.
        ((10, 20, 30, 40, 50), ("1970-01-01T00:00:00Z",), 50),
        # Five hours in which it lay still are nothing that it will need.
        (
            (10, 20, 5 * HOUR + 8, 5 * HOUR + 16, 5 * HOUR + 24),
            ("1970-01-01T00:00:00Z", "1970-01-01T05:00:00Z"),
            40,
        ),
        # Nothing is known of its speed before the second update of a resumed run.
        ((10, 20, 30, 40, 5 * HOUR + 8), ("1970-01-01T00:00:00Z", "1970-01-01T05:00:00Z"), None),
    ],
)
def test_the_time_left_is_by_the_speed_since_the_last_start(tmp_path, times, starts, left):
    write_run(tmp_path, times, starts)
    progress = train_progress(tmp_path, 1000)
    assert (progress.done, progress.total, progress.text) == (500, 1000, "streams 0.25")
    assert progress.seconds_left == left
