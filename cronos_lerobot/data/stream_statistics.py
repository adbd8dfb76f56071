"""What happened in recorded streams, counted: successes, and what segments began after."""

from __future__ import annotations

from typing import Any

import pandas as pd

from cronos_lerobot.data.schema import (
    EVENT,
    INTERVENED,
    POLICY_VERSION,
    SEGMENTS_SINCE_RESET,
    STEP,
    STREAM_ID,
    SUCCESS_FRAME,
)
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.protocol.interventions import BEFORE_SEGMENTS, Intervention
from cronos_lerobot.statistics import wilson_interval

NUM_PERIODS = 10
"""Parts of the recording that segments are counted in."""
BY = {
    "position": (SEGMENTS_SINCE_RESET, "task switches since the scene reset"),
    "task": ("task", "instruction"),
    "policy_version": (POLICY_VERSION, "policy version"),
    "stream": (STREAM_ID, "stream"),
}
"""What successes are counted by: a column and its name in words."""


def statistics(streams: StreamDataset) -> dict[str, Any]:
    """Count successes of recorded streams, and what their segments began after.

    Returns:
        `streams`, `segments`, `frames`; `success` and `success_by_{position,task,policy_version,stream}`:
        [successes, of these complete from the start, segments], by the number of task switches since the scene
        reset, and so on; `began_after`: segments by the event before them, the strongest where there were
        several; `began_after_over_time`: the same for each tenth of the steps, by its first step. `helped`:
        segments in which a person or a script acted, which all successes leave out.
    """
    rows = streams.rows.assign(task=streams.rows["tasks"].str[0])
    rows["success"], rows["found"] = rows[SUCCESS_FRAME] >= 0, rows[SUCCESS_FRAME] == 0
    own = rows[~rows[INTERVENED].astype(bool)]
    steps = int((rows[STEP] + rows["length"]).max())
    period = -(-steps // NUM_PERIODS)
    return {
        "streams": rows[STREAM_ID].nunique(),
        "segments": len(rows),
        "frames": int(rows["length"].sum()),
        "success": _successes(own),
        "helped": _successes(rows[rows[INTERVENED].astype(bool)]),
        **{
            f"success_by_{name}": {key: _successes(group) for key, group in own.groupby(column)}
            for name, (column, _) in BY.items()
        },
        "began_after": _kinds(rows),
        "began_after_over_time": {
            start: _kinds(rows[rows[STEP] // period == start // period]) for start in range(0, steps, period)
        },
    }


def make_tables(result: dict[str, Any]) -> list[pd.DataFrame]:
    """The statistics to print, with 95 % intervals: by position, task and policy version, and the events."""
    tables, together = [], [("all", result["success"]), ("with help", result["helped"])]
    for name in ("position", "task", "policy_version"):
        counts = [*result[f"success_by_{name}"].items(), *together]
        tables.append(pd.DataFrame([{BY[name][1]: key} | _cells(*n) for key, n in counts if n[2]]))
    kinds = [kind.name.lower() for kind in BEFORE_SEGMENTS]
    rows = [*result["began_after_over_time"].items(), ("all", result["began_after"])]
    began = pd.DataFrame([counts for _, counts in rows]).reindex(columns=kinds).fillna(0).astype(int)
    began.insert(0, "began after, from step", [key for key, _ in rows])
    return [*tables, began]


def _cells(successes: int, found: int, n: int) -> dict[str, Any]:
    low, high = wilson_interval(successes, n)
    rate = {"success": f"{successes / n:.3f}", "95 %": f"[{low:.2f}, {high:.2f}]"}
    return rate | {"complete from the start": found, "segments": n}


def _successes(rows: pd.DataFrame) -> list[int]:
    return [int(rows["success"].sum()), int(rows["found"].sum()), len(rows)]


def _kinds(rows: pd.DataFrame) -> dict[str, int]:
    counts = rows[EVENT].astype(int).value_counts().sort_index()
    return {Intervention(kind).name.lower(): int(count) for kind, count in counts.items()}
