"""Chooses the videos that a report shows, and embeds them."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path

from cronos_lerobot.report.lerobot_evaluations import EvaluationRun

MAX_CLIP_BYTES = 3_000_000
"""A longer video stays a file beside the page."""
MAX_TOTAL_BYTES = 30_000_000
"""Of all embedded videos together."""


@dataclass(frozen=True)
class Clip:
    """A video of the page."""

    title: str
    caption: str
    path: Path


def file_clips(paths: list[Path]) -> list[Clip]:
    """Clips of videos that were named on the command line."""
    return [Clip(path.stem.replace("_", " "), "", path) for path in paths]


def comparison_clips(before: list[EvaluationRun], after: list[EvaluationRun]) -> list[tuple[Clip, ...]]:
    """For each suite and task, the same episode before and after.

    The first recorded episode that failed before and succeeded after is taken, or the first of all.
    """
    pairs = []
    for new in after:
        old = next((run for run in before if run.suite == new.suite), None)
        if old is None:
            continue
        for task in new.videos:
            number = min(len(old.videos.get(task, [])), len(new.videos[task]))
            if number == 0:
                continue
            flags = list(zip(old.successes[task][:number], new.successes[task][:number], strict=True))
            episode = flags.index((False, True)) if (False, True) in flags else 0
            pairs.append((_clip(old, task, episode, "before"), _clip(new, task, episode, "after")))
    return pairs


def evaluation_clips(runs: list[EvaluationRun]) -> list[Clip]:
    """The first recorded episode of every task of every evaluation."""
    return [_clip(run, task, 0, run.name) for run in runs for task, paths in run.videos.items() if paths]


def _clip(run: EvaluationRun, task: str, episode: int, when: str) -> Clip:
    outcome = "success" if run.successes[task][episode] else "failure"
    caption = f"{when}, {run.suite}, episode {episode}: {outcome}"
    return Clip(task, caption, run.videos[task][episode])


class Embedder:
    """Turns files into data URLs, within the size that a page may have."""

    def __init__(self) -> None:
        self._left = MAX_TOTAL_BYTES

    def video(self, path: Path) -> str | None:
        """The video as a data URL, or None if it is too large."""
        size = path.stat().st_size
        if size > MAX_CLIP_BYTES or size > self._left:
            return None
        self._left -= size
        return data_url(path.read_bytes(), "video/mp4")


def data_url(content: bytes, mime_type: str) -> str:
    """`content` inside a URL."""
    return f"data:{mime_type};base64,{base64.b64encode(content).decode()}"
