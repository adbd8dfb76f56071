"""Videos and pictures of an evaluation: chains that went well, some that did not, and streams that got stuck."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from cronos_lerobot.evaluation.chains import ChainResult
from cronos_lerobot.evaluation.results import VIDEOS
from cronos_lerobot.evaluation.suites import INDEPENDENT, SEQUENTIAL, STREAM
from cronos_lerobot.film.encode import write_mp4
from cronos_lerobot.film.overlay import Status, draw_status
from cronos_lerobot.film.sheets import draw_grid, encode_palette_png

SPEED_UP, MAX_FPS = 4, 60
"""Four times as fast as it happened, as far as a screen can show it."""
LAST_FRAMES = 30
"""For how long the outcome stays on the screen [frames]."""
NUMBERED = {INDEPENDENT: "task", SEQUENTIAL: "ordering", STREAM: "first_task"}
"""What a chain's number is of."""
PICTURED = 4
"""Stuck streams on the sheet, and segments of each."""

Render = Callable[[np.ndarray], np.ndarray]
"""Frames (k, H, W, 3) uint8 of what trajectories keep, (k, ...)."""


def draw_suite(
    folder: Path,
    numbers: dict[str, Any],
    ended: Sequence[ChainResult],
    render: Render,
    count: int,
    fps: float,
) -> None:
    """Film some chains of a suite and split; of streams also draw `stuck.png`.

    Args:
        folder: of its results.json.
        numbers: its results.
        ended: its chains; those with a trajectory are filmed.
        render: draws what the trajectories keep.
        count: good chains to film at most, and bad ones.
        fps: control steps a second.
    """
    kept = [result for result in ended if result.frames]
    good, bad = choose(kept, count)
    films = [("good", result) for result in good] + [("bad", result) for result in bad]
    for kind, result in tqdm(films, unit="video", disable=None):
        number = f"{NUMBERED[numbers['suite']]}{result.chain.number}"
        name = f"{kind}_{number}_configuration{result.chain.configuration}.mp4"
        where = f"{numbers['split'].replace('_', '-')} {result.chain.configuration}, {number.replace('_', ' ')}"
        film_chain(folder / VIDEOS / name, result, render, where, fps)
    if numbers["suite"] == STREAM:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "stuck.png").write_bytes(encode_palette_png(draw_stuck(kept, render)))


def choose(ended: Sequence[ChainResult], count: int) -> tuple[list[ChainResult], list[ChainResult]]:
    """Choose the chains to film, of equals the first configurations.

    Returns:
        Up to `count` chains with a success, longest first, and up to `count` others that failed, shortest first.
    """

    def rank(result: ChainResult, sign: int) -> tuple[int, int, int]:
        return sign * result.length, result.chain.configuration, result.chain.number

    good = sorted((r for r in ended if r.length > 0), key=lambda r: rank(r, -1))[:count]
    failed = [r for r in ended if r.length < len(r.chain.tasks) and not any(r is other for other in good)]
    return good, sorted(failed, key=lambda r: rank(r, 1))[:count]


def film_chain(path: Path, result: ChainResult, render: Render, where: str, fps: float) -> None:
    """Write the MP4 of a chain, with its tasks and outcomes on it.

    Args:
        path: of the file.
        result: with its trajectory.
        render: draws what its trajectory keeps.
        where: what the chain is of, for the line at the bottom.
        fps: control steps a second.
    """
    assert result.trajectory is not None
    statuses, frames = list(_statuses(result, where)), []
    # Some at a time: all frames of a long chain without their overlay would double the memory.
    for start in range(0, len(statuses), 64):
        some = slice(start, start + 64)
        drawn = render(result.trajectory.states[some])
        frames += [draw_status(frame, status) for frame, status in zip(drawn, statuses[some], strict=True)]
    write_mp4(path, frames + frames[-1:] * LAST_FRAMES, round(min(SPEED_UP * fps, MAX_FPS)))


def _statuses(result: ChainResult, where: str) -> Iterator[Status]:
    trajectory, tasks = result.trajectory, result.chain.tasks
    assert trajectory is not None
    last = len(trajectory.states) - 1
    for t in range(last + 1):
        position = int(trajectory.position[t])
        status = Status(
            tasks[position].instruction,
            position,
            len(tasks),
            succeeded=bool(trajectory.is_complete[t]),
            outcomes=list(result.success[:position]),
            caption=f"{where}   task {position + 1}/{len(tasks)}   step {t}",
        )
        if t == last:
            outcome = "complete" if result.length == len(tasks) else "failed"
            status.message = f"{outcome}: {result.length} of {len(tasks)} tasks"
            status.outcomes = list(result.success)
        yield status


def draw_stuck(ended: Sequence[ChainResult], render: Render) -> Any:
    """The streams with the fewest tasks done in their second half, a row each: the ends of the last segments."""
    half = len(ended[0].success) // 2

    def done(result: ChainResult) -> int:
        found = set(result.found_complete)
        return sum(success and k not in found for k, success in enumerate(result.success) if k >= half)

    return draw_grid([_last_segments(result, render) for result in sorted(ended, key=done)[:PICTURED]])


def _last_segments(result: ChainResult, render: Render) -> list[np.ndarray]:
    trajectory, length = result.trajectory, len(result.success)
    assert trajectory is not None
    segments = range(length)[-PICTURED:]
    ends = [int(np.flatnonzero(trajectory.position == k)[-1]) for k in segments]
    statuses = [
        Status(
            result.chain.tasks[k].instruction,
            k,
            length,
            succeeded=result.success[k],
            outcomes=list(result.success[: k + 1]),
            caption=f"configuration {result.chain.configuration}",
            message=f"began {result.starts[k].replace('_', ' ')}" if result.starts else "",
        )
        for k in segments
    ]
    drawn = render(trajectory.states[ends])
    return [draw_status(frame, status) for frame, status in zip(drawn, statuses, strict=True)]
