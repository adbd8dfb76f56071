"""Reads the folders of `lerobot-eval`."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from lerobot_env_cronos import load_benchmark
from lerobot_env_cronos.benchmark.benchmark import SUITES

from cronos_lerobot.report.statistics import ChainRate, Rate, sum_rates

EVAL_INFO = "eval_info.json"
SEED = 1000
"""LeRobot's default. The file names none; another one matters where orderings start from other configurations."""


@dataclass
class EvaluationRun:
    """An output folder of `lerobot-eval`."""

    folder: Path
    suite: str
    """LeRobot's task group, e.g. `independent_held_out`."""
    successes: dict[str, list[bool]]
    """By instruction, or ordering of a sequential suite: one flag for each episode."""
    videos: dict[str, list[Path]]
    """By instruction: the videos of the first episodes, in their order."""
    starts: dict[str, list[int]]
    """By ordering of a sequential suite: the configurations that its chains begin with, again and again."""

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.folder.resolve().name

    @property
    def tasks(self) -> dict[str, Rate]:
        """Success by instruction or ordering."""
        if not self.suite.startswith("sequential"):
            return {task: Rate(sum(flags), len(flags)) for task, flags in self.successes.items()}
        return {name: ChainRate.of(flags, self.starts[name]) for name, flags in self.successes.items()}

    @property
    def overall(self) -> Rate:
        """Success of all tasks together."""
        return sum_rates(self.tasks.values())


def read_evaluation_runs(
    folder: Path, scene: str = "kitchen_2x2", benchmark: str | None = None
) -> list[EvaluationRun]:
    """Read an output folder of `lerobot-eval`: one EvaluationRun for each suite in it.

    Args:
        folder: holds eval_info.json.
        scene: the scene, which the file does not name; its tasks are numbered in the file.
        benchmark: whose episodes they are, as `--env.benchmark` names it; the package's by default.

    Raises:
        ValueError: it is of an environment other than CRONOS, or of a split that there is not.
    """
    episodes = load_benchmark(benchmark, scene)
    runs: dict[str, EvaluationRun] = {}
    for entry in json.loads((folder / EVAL_INFO).read_text())["per_task"]:
        suite, number = entry["task_group"], entry["task_id"]
        kind, _, split = suite.partition("_")
        if kind not in SUITES:
            raise ValueError(
                f"{folder / EVAL_INFO} is of another environment: its task group is {suite!r}, those of CRONOS"
                f" begin with {' or '.join(SUITES)}"
            )
        groups = {group.number: group for group in episodes.groups(kind, split)}
        run = runs.setdefault(suite, EvaluationRun(folder, suite, {}, {}, {}))
        if kind == "sequential":
            task = f"ordering {number}"  # an episode is a chain of all tasks
            everywhere = range(len(episodes.configurations[split]))
            own = groups[number].configurations if number in groups else everywhere
            run.starts[task] = [own[(SEED + i) % len(own)] for i in range(len(own))]
        else:
            task = groups[number].instructions[0] if number in groups else f"task {number}"
        run.successes[task] = [bool(flag) for flag in entry["metrics"]["successes"]]
        paths = [Path(path) for path in entry["metrics"].get("video_paths", [])]
        # The paths are as seen when the evaluation ran; the folder may have moved since.
        moved = [folder / "videos" / path.parent.name / path.name for path in paths]
        run.videos[task] = [path for path in moved if path.is_file()]
    return list(runs.values())
