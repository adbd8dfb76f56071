"""What happened in recorded streams, counted: successes, and what segments began after."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from lerobot_env_cronos.statistics import wilson_interval
from rich.table import Table

from cronos_lerobot.data.streams import Segment, StreamDataset
from cronos_lerobot.protocol.interventions import BEFORE_SEGMENTS

NUM_PERIODS = 10
"""Parts of the recording that segments are counted in."""


def statistics(streams: StreamDataset) -> dict[str, Any]:
    """Count successes of recorded streams, and what their segments began after.

    Returns:
        `streams`, `segments`, `frames`; `success` and `success_by_{position,task,policy_version,stream}`:
        [successes, of these complete from the start, segments], by the number of task switches since the scene
        reset, and so on; `began_after`: segments by the intervention before them, the strongest where there were
        several; `began_after_over_time`: the same for each tenth of the steps, by its first step. `takeovers`:
        [successes, of these complete from the start, segments] of an expert; all other successes are the policy's.
    """
    segments = streams.segments
    own = [s for s in segments if not s.taken_over]
    keys: dict[str, Callable[[Segment], Any]] = {
        "position": lambda s: s.position,
        "task": lambda s: s.task,
        "policy_version": lambda s: s.policy_version,
        "stream": lambda s: s.stream,
    }
    steps = max(s.step + s.length for s in segments)
    period = -(-steps // NUM_PERIODS)
    over_time = {start: _kinds(s for s in segments if s.step // period == start // period)
                 for start in range(0, steps, period)}  # fmt: skip
    return {
        "streams": len(streams.streams),
        "segments": len(segments),
        "frames": sum(s.length for s in segments),
        "success": _successes(own),
        "takeovers": _successes([s for s in segments if s.taken_over]),
        **{f"success_by_{name}": _by(own, key) for name, key in keys.items()},
        "began_after": _kinds(segments),
        "began_after_over_time": over_time,
    }


def make_tables(result: dict[str, Any]) -> list[Table]:
    """The statistics for the console, with 95 % intervals."""
    title = f"{result['streams']} streams, {result['segments']} segments, {result['frames']} frames"
    tables = []
    headings = {
        "position": "task switches since the scene reset",
        "task": "instruction",
        "policy_version": "policy version",
    }
    for name, heading in headings.items():
        table = Table(heading, "success", "95 %", "complete from the start", "segments", title=title)
        rows = [*result[f"success_by_{name}"].items(), ("all", result["success"])]
        for key, counts in [*rows, ("takeovers by an expert", result["takeovers"])]:
            if counts[-1]:
                table.add_row(str(key), *_cells(*counts))
        tables.append(table)
        title = ""
    kinds = [kind.name.lower() for kind in BEFORE_SEGMENTS]
    table = Table("segments that began after, from step", *kinds)
    for key, counts in [*result["began_after_over_time"].items(), ("all", result["began_after"])]:
        table.add_row(str(key), *(str(counts.get(kind, 0)) for kind in kinds))
    return [*tables, table]


def _by(segments: Iterable[Segment], key: Callable[[Segment], Any]) -> dict[Any, list[int]]:
    groups: dict[Any, list[Segment]] = {}
    for segment in segments:
        groups.setdefault(key(segment), []).append(segment)
    return {name: _successes(groups[name]) for name in sorted(groups)}


def _successes(segments: list[Segment]) -> list[int]:
    return [sum(s.success for s in segments), sum(s.found_complete for s in segments), len(segments)]


def _kinds(segments: Iterable[Segment]) -> dict[str, int]:
    counts = Counter(segment.intervention for segment in segments)
    return {kind.name.lower(): counts[kind] for kind in sorted(counts)}


def _cells(successes: int, found: int, n: int) -> tuple[str, ...]:
    low, high = wilson_interval(successes, n)
    return f"{successes / n:.3f}", f"[{low:.2f}, {high:.2f}]", str(found), str(n)
