"""results.json of a suite and split: its numbers from the outcomes of its chains, and how it is found and read."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot_env_cronos import EpisodeGroup

from cronos_lerobot.environment_id import check_environment_id
from cronos_lerobot.evaluation.chains import ChainResult
from cronos_lerobot.evaluation.suites import SPLITS, STREAM, SUITES, Benchmark, Start
from cronos_lerobot.protocol.streams import Task
from cronos_lerobot.statistics import cluster_interval, effective_trials
from cronos_lerobot.whole_files import written_whole

RESULTS = "results.json"
VIDEOS = "videos"
"""Folder beside it."""
FORMAT = 3
"""Version of results.json."""
FIELDS = {"policy": str, "policy_fingerprint": str, "scene": str, "benchmark": dict, "episodes": list, "n": int}
"""Fields of every results.json, with their types."""

Episode = Mapping[str, Any]
"""Outcome of a chain: `number` (task, ordering, or first task of the stream), `configuration`, `seed` (of the
action sampling), `length` (tasks completed), `steps`, `found_complete` and, if the world says what is grasped,
`never_grasped` (positions, see `ChainResult`). Of a stream also `success` and, if the world says it, `starts` (by
segment)."""


def folder_name(suite: str, split: str) -> str:
    """Where a suite and split lies in the output folder."""
    return f"{suite}_{split}"


FOLDERS = tuple(folder_name(suite, split) for suite in SUITES for split in SPLITS)


def result_files(output_dir: Path) -> list[Path]:
    """Where `cronos-eval` writes the results of each suite and split."""
    return [output_dir / name / RESULTS for name in FOLDERS]


def find_results(folder: Path) -> list[Path]:
    """Return every results.json of `cronos-eval` in a folder or anywhere below it."""
    files = [file for file in folder.rglob(RESULTS) if file.parent.absolute().name in FOLDERS]
    return sorted(files, key=lambda file: (file.parent.parent, FOLDERS.index(file.parent.absolute().name)))


def read_evaluation(path: Path) -> list[dict[str, Any]]:
    """Read a results.json, or all of them in an output folder of `cronos-eval`; see `read_results`.

    Raises:
        FileNotFoundError: there is none.
    """
    files = [path] if path.is_file() else find_results(path)
    if not files:
        raise FileNotFoundError(f"no {RESULTS} of cronos-eval at {path}")
    return [read_results(file) for file in files]


def find_videos(results: Path) -> list[Path]:
    """Return the videos beside a results.json.

    Paths inside the file are never followed, and no link that leads out of the folder.
    """
    home, found = results.parent.resolve(), results.parent.glob(f"{VIDEOS}/*.mp4")
    return sorted(path for path in found if path.is_file() and path.resolve().is_relative_to(home))


def read_results(file: Path) -> dict[str, Any]:
    """Read a results.json, also one of a stranger.

    Raises:
        OSError: it is not there.
        ValueError: it is damaged, something else, or of another version of the environments.
    """
    try:
        results = json.loads(file.read_text())
        environment = results["environment"]
    except (ValueError, RecursionError, TypeError, KeyError) as error:
        raise ValueError(f"{file} is damaged, or no {RESULTS} of cronos-eval: {error!r}") from error
    check_environment_id(environment, str(file), "evaluate again with another --output_dir")
    is_known = (results.get("format"), results.get("suite") in SUITES, results.get("split") in SPLITS)
    if is_known != (FORMAT, True, True) or not all(isinstance(results.get(k), kind) for k, kind in FIELDS.items()):
        raise ValueError(f"{file} is damaged, or not of format {FORMAT}: evaluate again with another --output_dir")
    return results


def write_json(path: Path, content: Any) -> None:
    """Write a file as a whole or not at all."""
    with written_whole(path) as file:
        file.write(json.dumps(content, indent=1) + "\n")


def describe_episodes(
    results: Sequence[ChainResult], seed: int, *, of_streams: bool = False
) -> list[dict[str, Any]]:
    """Outcomes as JSON values, see `Episode`."""
    episodes = []
    for r in results:
        episode: dict[str, Any] = {"number": r.chain.number, "configuration": r.chain.configuration, "seed": seed}
        episode |= {"length": r.length, "steps": r.steps}
        episode |= {"found_complete": r.found_complete}
        if r.never_grasped is not None:
            episode |= {"never_grasped": r.never_grasped}
        if of_streams:
            episode |= {"success": r.success}
        if r.starts:
            episode |= {"starts": r.starts}
        episodes.append(episode)
    return episodes


def success_rate(episodes: Sequence[Episode], position: int = 0) -> dict[str, Any]:
    """Success of the tasks at a position of some chains, with its interval.

    Every chain counts: a task after a failed one is a failure. Chains of one configuration are correlated, so the
    interval is clustered by configuration.

    Returns:
        `success`, `n`, `ci95`, `effective_n`, and the counts `found_complete` and, if known, `never_grasped`.
    """
    success = np.array([e["length"] > position for e in episodes])
    return _rate(success, np.array([e["configuration"] for e in episodes])) | {
        name: sum(position in e[name] for e in episodes)
        for name in ("found_complete", "never_grasped")
        if all(name in e for e in episodes)
    }


def _rate(success: np.ndarray, configurations: np.ndarray) -> dict[str, Any]:
    """Rate, n and interval of successes (n,) bool, clustered by configuration (n,)."""
    interval = list(cluster_interval(success, configurations))
    rate = {"success": float(success.mean()), "n": len(success), "ci95": interval}
    return rate | {"effective_n": effective_trials(success, configurations)}


def independent_results(episodes: Sequence[Episode], tasks: Sequence[Task]) -> dict[str, Any]:
    """Success of all tasks together, and `per_task` by instruction."""
    by_task = {task.instruction: [e for e in episodes if e["number"] == i] for i, task in enumerate(tasks)}
    return success_rate(episodes) | {"per_task": {text: success_rate(some) for text, some in by_task.items()}}


def sequential_results(episodes: Sequence[Episode], groups: Sequence[EpisodeGroup]) -> dict[str, Any]:
    """Success by position and the average chain length: of all orderings, and apart for those seen in training.

    Args:
        episodes: of the chains of whole orderings.
        groups: the orderings; those without an episode are left out. A piece of the training cycle is `seen`.
    """
    numbers = sorted({e["number"] for e in episodes})
    seen = [i for i in numbers if groups[i].is_training_cycle]
    num_tasks = len(groups[0].tasks)
    kinds = {
        name: _summary([e for e in episodes if e["number"] in some], num_tasks) if some else None
        for name, some in (("seen", seen), ("unseen", [i for i in numbers if i not in seen]))
    }
    per_ordering = []
    for i in numbers:
        lengths = np.array([e["length"] for e in episodes if e["number"] == i])
        tasks = groups[i].instructions
        row = {"ordering": i, "tasks": tasks, "seen": i in seen, "n": len(lengths)}
        row |= {"positions": [float((lengths > k).mean()) for k in range(num_tasks)]}
        per_ordering.append(row | {"average_chain_length": float(lengths.mean())})
    return _summary(episodes, num_tasks) | kinds | {"per_ordering": per_ordering}


def _summary(episodes: Sequence[Episode], num_tasks: int) -> dict[str, Any]:
    """Success at each position and the chain length of some orderings' chains.

    `std` is the sample standard deviation over the orderings, each first averaged over its configurations; None
    for one ordering. The chain length is the sum of the positions' rates. Its interval is the sum of their
    intervals, as if the positions of a chain were fully correlated.
    """
    lengths, numbers = (np.array([e[name] for e in episodes]) for name in ("length", "number"))
    orderings = np.unique(numbers)

    def spread(values: np.ndarray) -> float | None:
        means = [values[numbers == i].mean() for i in orderings]
        return float(np.std(means, ddof=1)) if len(means) > 1 else None

    positions = [success_rate(episodes, k) | {"std": spread(lengths > k)} for k in range(num_tasks)]
    ci95 = np.sum([position["ci95"] for position in positions], axis=0).tolist()
    return {
        "n": len(episodes),
        "orderings": len(orderings),
        "configurations": len({e["configuration"] for e in episodes}),
        "positions": positions,
        "average_chain_length": {"mean": float(lengths.mean()), "std": spread(lengths), "ci95": ci95},
    }


def stream_results(episodes: Sequence[Episode], cycle: int) -> dict[str, Any]:
    """Success by segment, by how the segments began, and what streams get stuck on.

    A stream is stuck if the policy completed no task in its last `cycle` segments, in which it was given every
    task once. Tasks that were found complete do not count. Its cause is how most of these segments began.

    Args:
        episodes: of streams of one length.
        cycle: tasks of the scene.

    Returns:
        `success`, `n` (streams), `ci95`, `effective_n` of all segments; `done` (success without the segments found
        complete); `share_found_complete`; `by_segment`; `by_start`, with each `share`; `stuck`. Where the world
        does not say how segments begin, there are no starts and no causes.
    """
    success = np.array([e["success"] for e in episodes])
    num_streams, length = success.shape
    configurations = np.repeat([[e["configuration"]] for e in episodes], length, axis=1)
    found, starts = _starts(episodes, length)

    def rate(mask: np.ndarray) -> dict[str, Any] | None:
        return _rate(success[mask], configurations[mask]) if mask.any() else None

    by_start = {start.value: rate(starts == start) for start in Start}
    segments = [
        _rate(success[:, k], configurations[:, k])
        | {"share_found_complete": float(found[:, k].mean())}
        | {"starts": {name.value: int((starts[:, k] == name).sum()) for name in Start if (starts != "").any()}}
        for k in range(length)
    ]
    grasps = [e["never_grasped"] for e in episodes if "never_grasped" in e]
    shares = {name: {"share": r["n"] / success.size} for name, r in by_start.items() if r}
    return (rate(np.ones_like(success)) or {}) | {
        "n": num_streams,
        "segments": length,
        "done": rate(~found),
        "share_found_complete": float(found.mean()),
        **({"never_grasped": sum(map(len, grasps))} if grasps else {}),
        "by_segment": segments,
        "by_start": {name: r | shares[name] for name, r in by_start.items() if r},
        "stuck": _stuck(success & ~found, starts, min(cycle, length)),
    }


def _starts(episodes: Sequence[Episode], length: int) -> tuple[np.ndarray, np.ndarray]:
    """Which segments (n, length) were found complete, and how they began: "" where that is not known."""
    if all("starts" in e for e in episodes):
        starts = np.array([e["starts"] for e in episodes])
        return starts == Start.COMPLETE, starts
    found = np.zeros((len(episodes), length), bool)
    for row, episode in zip(found, episodes, strict=True):
        row[episode["found_complete"]] = True
    return found, np.full(found.shape, "")


def _stuck(done: np.ndarray, starts: np.ndarray, last: int) -> dict[str, Any]:
    """Streams in which the policy did no task in the last segments, and their causes; see `stream_results`."""
    stuck = np.flatnonzero(~done[:, -last:].any(axis=1))
    causes = Counter(Counter(starts[i, -last:].tolist()).most_common(1)[0][0] for i in stuck if starts[i, 0])
    return {"streams": len(stuck), "share": len(stuck) / len(done), "causes": dict(causes.most_common())}


def numbers_of(suite: str, episodes: Sequence[Episode], benchmark: Benchmark, split: str) -> dict[str, Any]:
    """The numbers of a suite and split."""
    if suite == STREAM:
        return stream_results(episodes, len(benchmark.tasks))
    groups = benchmark.groups(suite, split)
    if suite == SUITES[0]:
        return independent_results(episodes, [group.tasks[0] for group in groups])
    return sequential_results(episodes, groups)
