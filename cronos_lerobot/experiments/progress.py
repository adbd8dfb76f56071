"""Reads from a run's metrics how far it has come."""

from __future__ import annotations

import json
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from cronos_lerobot.experiments.jobs import Progress
from cronos_lerobot.training.logging import MANIFEST, METRICS, read_starts


def train_progress(folder: Path, total: int) -> Progress | None:
    """Read from metrics.jsonl how far a run is; None before its first record."""
    records = _last_records(folder / METRICS)
    if not records:
        return None
    updates = [record for record in records if record["kind"] == "update"]
    done = records[-1]["interaction_steps"]
    left, started = None, _started(folder)
    timed = [record for record in updates if record["time"] >= started]
    if len(timed) > 1:
        steps = timed[-1]["interaction_steps"] - timed[0]["interaction_steps"]
        left = (total - done) * (timed[-1]["time"] - timed[0]["time"]) / max(steps, 1)
    texts = [f"evaluation {r['success']:.2f}" for r in records if r["kind"] == "evaluation"][-1:]
    if updates and updates[-1]["rollout"]["success"] is not None:
        texts.append(f"streams {updates[-1]['rollout']['success']:.2f}")
    return Progress(done, total, left, ", ".join(texts))


def _started(folder: Path) -> float:
    """When a run was last begun or resumed [s since the epoch], before which it may have lain still."""
    # Whatever is wrong with the manifest is the run's to report.
    with suppress(OSError, ValueError):
        return datetime.fromisoformat(read_starts(folder / MANIFEST)[-1]["time"]).timestamp()
    return 0.0


def _last_records(path: Path, num_bytes: int = 100_000) -> list[dict[str, Any]]:
    """The last records of a JSON-lines file; one that is being written is left out."""
    if not path.is_file():
        return []
    with path.open("rb") as file:
        start = max(0, path.stat().st_size - num_bytes)
        file.seek(start)
        lines = file.read().split(b"\n")
    # What follows the last newline is unfinished, what precedes the first one may be cut.
    return [json.loads(line) for line in lines[1 if start else 0 : -1]]
