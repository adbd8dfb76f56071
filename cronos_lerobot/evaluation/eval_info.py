"""eval_info.json: an evaluation in the format of LeRobot 0.6.1's `lerobot-eval`, for tools that read that."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cronos_lerobot.evaluation.results import find_videos, read_results, result_files, write_json
from cronos_lerobot.evaluation.suites import INDEPENDENT, STREAM
from cronos_lerobot.statistics import wilson_interval

EVAL_INFO = "eval_info.json"


def write_eval_info(folder: Path) -> None:
    """Write eval_info.json of all results in an output folder."""
    files = [file for file in result_files(folder) if file.is_file()]
    results = [read_results(file) for file in files]
    per_task, per_group = [], {}
    for one, file in zip(results, files, strict=True):
        group = f"{one['scene']}_{one['suite']}_{one['split']}"
        tasks = [_task(group, number, one) for number in sorted({e["number"] for e in one["episodes"]})]
        per_task += tasks
        per_group[group] = _aggregate([t["metrics"] for t in tasks], [str(path) for path in find_videos(file)])
    overall = _aggregate(
        [task["metrics"] for task in per_task], [path for g in per_group.values() for path in g["video_paths"]]
    )
    seconds = sum(one["seconds"] for one in results)
    overall |= {"eval_s": seconds, "eval_ep_s": seconds / max(1, overall["n_episodes"])}
    write_json(folder / EVAL_INFO, {"per_task": per_task, "per_group": per_group, "overall": overall})


def _task(group: str, number: int, results: dict[str, Any]) -> dict[str, Any]:
    """The episodes of a task, ordering, or first task of a stream.

    An episode's sum of rewards is the number of tasks that it completed. Its seed is the configuration: with it
    `lerobot-eval` resets the packaged benchmark to the same start.
    """
    episodes = [e for e in results["episodes"] if e["number"] == number]
    goal = {INDEPENDENT: 1, STREAM: results.get("segments")}.get(results["suite"]) or len(results["positions"])
    metrics = {
        "sum_rewards": [float(e["length"]) for e in episodes],
        "max_rewards": [float(e["length"] > 0) for e in episodes],
        "successes": [e["length"] == goal for e in episodes],
        "video_paths": [],
        "predicted_video_paths": [],
        "seeds": [e["configuration"] for e in episodes],
        "sampling_seeds": [e["seed"] for e in episodes],
    }
    return {"task_group": group, "task_id": number, "metrics": metrics} | _counts(metrics["successes"])


def _counts(successes: Sequence[bool]) -> dict[str, Any]:
    """LeRobot's newer keys [%]; its interval takes the episodes as independent."""
    k, n = sum(successes), len(successes)
    interval = [100 * bound for bound in wilson_interval(k, n)]
    return {"n_episodes": n, "n_success": k, "pc_success": 100 * k / n, "pc_success_ci95": interval}


def _aggregate(metrics: Sequence[dict[str, Any]], video_paths: list[str]) -> dict[str, Any]:
    means = {
        f"avg_{name}": float(np.mean([value for one in metrics for value in one[f"{name}s"]]))
        for name in ("sum_reward", "max_reward")
    }
    counts = _counts([success for one in metrics for success in one["successes"]])
    return means | counts | {"video_paths": video_paths, "predicted_video_paths": []}
