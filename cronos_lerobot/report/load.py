"""Reads runs and evaluations into pandas tables.

What cannot be read is left out and said. All numbers are checked here, so that drawing cannot fail later.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cronos_lerobot.evaluation.results import find_results, find_videos, read_results
from cronos_lerobot.report.runs import TrainingRun, group_runs, read_training_run
from cronos_lerobot.training.run_folder import METRICS

TRAIN, CRONOS_EVAL = "cronos-train", "cronos-eval"
"""Values of the column `source`."""
SETTING = (
    "scene", "environment", "benchmark", "advance", "end_effector_reset", "temperature", "obs_type", "renderer",
    "versions",
)  # fmt: skip
"""Keys of the column `setting`: how an evaluation was made."""
IDENTITY = ["experiment", "row", "seed", "run", "folder"]
EVALUATIONS = [
    *IDENTITY, "source", "steps", "interventions", "split", "suite", "n", "success", "ci95_low", "ci95_high",
    "found_complete", "never_grasped", "policy", "fingerprint", "path", "trained_in", "is_budget_spent",
    "parts", "episodes", "setting",
]  # fmt: skip
UPDATES = [
    *IDENTITY, "steps", "interventions", "updates", "steps_per_s", "success", "segments", "reward_per_segment",
    "diverged",
]  # fmt: skip
SEGMENTS = [*IDENTITY, "steps", "cycle", "is_late", "kind", "part", "successes", "n"]
TABLES = ("evaluations", "updates", "segments", "interventions")
APART = ("found_complete", "never_grasped")
"""Of the successes: those of tasks that were complete when they were given; others without a grasp, if known."""
LENGTH = 300
"""Characters of a sentence on what is left out."""

Cells = dict[str, Any]


@dataclass(frozen=True)
class Video:
    """A video of an evaluation, below its folder."""

    path: Path
    title: str
    caption: str


@dataclass
class Loaded:
    """What some folders hold."""

    runs: list[TrainingRun] = field(default_factory=list)
    """Of cronos-train. Of several runs of one seed and the same settings only the longest."""
    evaluations: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=EVALUATIONS))
    """See `load_evaluations`."""
    updates: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=UPDATES))
    """See `load_metrics`."""
    segments: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=SEGMENTS))
    """Successes of n training segments by update and `part`. `kind` is `segment` (number since the scene reset,
    from 0) or `task` (instruction). `cycle` is the number of steps between two scene resets, 0 if there is none;
    `is_late` is true at the end of the run."""
    interventions: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=IDENTITY))
    """Of each run: all, the extremes of a stream, and by kind."""
    videos: list[Video] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    """A sentence for each thing that could not be read or is not shown."""


def load_evaluations(folders: Iterable[Path]) -> pd.DataFrame:
    """Read the evaluations by cronos-train and cronos-eval in folders and below them, see `load`.

    Returns:
        One row per evaluation:
        source; experiment (job name of the run); row (what tells it from other runs, or the policy); seed; run and
        folder; steps and interventions of the training; split; suite; n; success, ci95_low and ci95_high;
        found_complete and never_grasped; policy; fingerprint; path; trained_in (folder of the run that made the
        policy); is_budget_spent, of cronos-train alone; parts (cells by task, position or segment); episodes
        ((n, 4) int: seed, number, configuration, length); setting (see `SETTING`).
    """
    return load(folders).evaluations


def load_metrics(folders: Iterable[Path]) -> pd.DataFrame:
    """Read the policy updates of cronos-train in some folders and below them, see `load`.

    Returns:
        One row per update: experiment, row, seed, run, folder, steps, interventions, updates, success, segments,
        reward_per_segment, diverged, steps_per_s, `agent/...` and `time/...`.
    """
    return load(folders).updates


def load(folders: Iterable[Path]) -> Loaded:
    """Read all runs and evaluations in some folders and below them, each once.

    Raises:
        FileNotFoundError: a folder is missing or holds no run and no evaluation.
        ValueError: nothing can be read.
    """
    metrics, results = _find(folders)
    left_out: list[str] = []
    read = _read_each(metrics, lambda path: tables_of(read_training_run(path.parent)), left_out)
    by_folder = {one.runs[0].folder: one for one in read}
    loaded = []
    for label, runs in group_runs([one.runs[0] for one in read], left_out).items():
        for one in (by_folder[run.folder] for run in runs):
            for name in TABLES:
                getattr(one, name)["row"] = label
            loaded.append(one)
    runs = [one.runs[0] for one in loaded]
    left_out += [text for run in runs for text in _said_of(run)]
    loaded += _read_each(results, _read_results, left_out)
    if not loaded:
        raise ValueError("; ".join(left_out))
    whole = Loaded(runs, videos=[video for one in loaded for video in one.videos], left_out=left_out)
    for name in TABLES:
        if tables := [table for one in loaded if len(table := getattr(one, name))]:
            found = pd.concat(tables, ignore_index=True)
            columns = dict.fromkeys([*getattr(whole, name), *found])
            setattr(whole, name, found.reindex(columns=columns))
    _add_runs(whole.evaluations)
    return whole


def _find(folders: Iterable[Path]) -> tuple[list[Path], list[Path]]:
    """The files of cronos-train and of cronos-eval."""
    metrics: dict[Path, None] = {}
    results: dict[Path, None] = {}
    for folder in folders:
        of_runs, of_evaluations = sorted(folder.rglob(METRICS)), find_results(folder)
        if not of_runs and not of_evaluations:
            raise FileNotFoundError(
                f"{folder} has no {METRICS} of cronos-train and no results.json of cronos-eval"
            )
        metrics |= dict.fromkeys(path.resolve() for path in of_runs)
        results |= dict.fromkeys(path.resolve() for path in of_evaluations)
    return list(metrics), list(results)


def _read_each[T](paths: Sequence[Path], read: Callable[[Path], T], left_out: list[str]) -> list[T]:
    found = []
    for path in paths:
        try:
            found.append(read(path))
        except Exception as error:
            # Files of other people: whatever is wrong with one, the others are shown.
            text = str(error) if str(path.parent) in str(error) else f"{path} is damaged: {error!r}"
            left_out.append(" ".join(text.split())[:LENGTH])
    return found


def tables_of(run: TrainingRun) -> Loaded:
    """The tables of a run; its row is its name.

    Raises:
        ValueError, KeyError, TypeError: its records are damaged.
    """
    who = {"experiment": run.config.get("job_name"), "row": run.name, "seed": run.seed, "run": run.name}
    who["folder"] = str(run.folder)

    def table(rows: Iterable[Cells], columns: Sequence[str]) -> pd.DataFrame:
        found = pd.DataFrame([who | row for row in rows])
        return found if len(found) else pd.DataFrame(columns=columns)

    last, streams = run.last, run.last.get("interventions_by_stream")
    counts = {"steps": last["interaction_steps"], "interventions": last["interventions"]}
    counts |= {"fewest of a stream": min(streams), "most of a stream": max(streams)} if streams else {}
    counts |= {name: int(count) for name, count in last["interventions_by_kind"].items()}
    found = Loaded(
        [run],
        table(_evaluation_cells(run), EVALUATIONS),
        table(map(_update_cells, run.updates), UPDATES),
        table(_segment_cells(run), SEGMENTS),
        table([counts], IDENTITY),
    )
    for counted in (found.evaluations, found.updates):
        _check_counters(counted)
    return found


def _check_counters(table: pd.DataFrame) -> None:
    for name in ("steps", "interventions"):
        if len(table) and not (np.isfinite(table[name]).all() and table[name].is_monotonic_increasing):
            raise ValueError(f"{name} must be numbers that never fall")


def _evaluation_cells(run: TrainingRun) -> Iterator[Cells]:
    start, env = run.starts[-1], run.config["env"]
    setting = dict.fromkeys(SETTING) | {name: env.get(name) for name in ("scene", "obs_type", "renderer")}
    setting |= {name: start.get(name) for name in ("environment", "versions")}
    setting["benchmark"] = (start.get("benchmark") or {}).get("fingerprint")
    budget = run.config["protocol"].get("reset_budget")
    for one in run.evaluations:
        steps, interventions = one["interaction_steps"], one["interventions"]
        cells = {"source": TRAIN, "steps": steps, "interventions": interventions, "split": str(one["split"])}
        cells |= {"suite": "independent", "policy": run.name, "fingerprint": f"{run.folder} {steps}"}
        cells |= {"path": str(run.folder / METRICS), "trained_in": str(run.folder)}
        cells |= {"is_budget_spent": budget is not None and interventions >= budget}
        cells |= {"parts": [{"part": str(task)} | _rate(rate) for task, rate in one["per_task"].items()]}
        cells |= {"episodes": np.array(one["episodes"], int).reshape(-1, 4)}
        yield cells | _rate(one) | {"setting": setting | {"temperature": one["temperature"]}}


def _update_cells(update: Cells) -> Cells:
    rollout = update["rollout"]
    cells = {"steps": update["interaction_steps"], "interventions": update["interventions"]}
    cells |= {"updates": update["updates"], "steps_per_s": update["steps_per_s"]}
    cells |= {name: rollout[name] for name in ("success", "segments", "reward_per_segment", "diverged")}
    cells |= {name: rollout[name][0] for name in APART if name in rollout}
    cells |= {f"agent/{name}": value for name, value in (update.get("agent") or {}).items()}
    cells |= {f"time/{name}": value for name, value in update["time_share"].items()}
    return {name: np.nan if value is None else float(value) for name, value in cells.items()}


def _segment_cells(run: TrainingRun) -> Iterator[Cells]:
    cycle = (run.config["protocol"].get("scene_reset_interval") or 0) * run.config["num_envs"]
    late = _late_from(run, cycle)
    for update in run.updates:
        steps = int(update["interaction_steps"])
        for kind, convert in (("segment", int), ("task", str)):
            for part, (successes, n) in update["rollout"][f"success_by_{kind}"].items():
                if not 0 <= successes <= n or n < 1 or (kind == "segment" and not 0 <= int(part) < steps):
                    raise ValueError(f"no success rate of {kind} {part}: {successes} of {n}")
                where = {"steps": steps, "cycle": cycle, "is_late": steps > late}
                yield where | {"kind": kind, "part": convert(part), "successes": int(successes), "n": int(n)}


def _late_from(run: TrainingRun, cycle: int) -> float:
    """Where the end of a run begins: its last quarter, or a longer whole cycle between two scene resets.

    A cycle of more than a third of the run does not stand for its end.
    """
    end = run.updates[-1]["interaction_steps"] if run.updates else 0
    return min(end * 0.75, end - cycle if 3 * cycle <= end else end)


def _rate(found: Cells) -> Cells:
    """Columns of a success rate, checked.

    Raises:
        ValueError: these are no numbers, or impossible ones.
    """
    low, high = map(float, found["ci95"])
    cells = {"n": int(found["n"]), "success": float(found["success"]), "ci95_low": low, "ci95_high": high}
    if cells["n"] < 1 or not all(0 <= value <= 1 for value in (low, high, cells["success"])):
        raise ValueError(f"no success rate: {cells}")
    return cells | {name: int(found[name]) for name in APART if name in found}


def _said_of(run: TrainingRun) -> Iterator[str]:
    """What the evaluations of a run do not say."""
    if run.evaluations and (first := run.evaluations[0]["interaction_steps"]):
        yield f"success before, D and C of {run.folder}: the first evaluation is after {first:,} steps"


def _read_results(path: Path) -> Loaded:
    results = read_results(path)
    columns = ("seed", "number", "configuration", "length")
    episodes = np.array([[episode[name] for name in columns] for episode in results["episodes"]], int)
    overall = results if "success" in results else results["positions"][-1]
    folder, found, checkpoint = results["policy"].partition("/checkpoints/")
    step = checkpoint.split("/")[0]
    cells = _rate(overall) | {name: results[name] for name in ("split", "suite")}
    cells |= {"source": CRONOS_EVAL, "n": len(episodes), "policy": policy_name(results["policy"])}
    cells |= {"fingerprint": results["policy_fingerprint"], "path": str(path), "parts": list(_parts(results))}
    cells |= {"trained_in": str(Path(folder).resolve()) if found else ""}
    cells |= {"steps": int(step) if step.isdigit() else np.nan, "episodes": episodes.reshape(-1, 4)}
    fingerprint = results["benchmark"]["fingerprint"]
    cells["setting"] = {name: results.get(name) for name in SETTING} | {"benchmark": fingerprint}
    title = f"{results['suite']}, {results['split'].replace('_', '-')}"
    caption = f"{cells['policy']}: "
    videos = [Video(video, title, caption + video.stem.replace("_", " ")) for video in find_videos(path)]
    return Loaded(evaluations=pd.DataFrame([cells]), videos=videos)


def _parts(results: Cells) -> Iterator[Cells]:
    """Numbers by task, by position in a chain, or by segment of a stream."""
    for task, rate in results.get("per_task", {}).items():
        yield {"part": str(task)} | _rate(rate)
    for orderings in ("all", "seen", "unseen") if "positions" in results else ():
        if found := results if orderings == "all" else results.get(orderings):
            for k, position in enumerate(found["positions"]):
                yield {"part": f"SEQ {k}", "orderings": orderings} | _rate(position) | {"std": position["std"]}
            length, (low, high) = found["average_chain_length"], found["average_chain_length"]["ci95"]
            cells: Cells = {"part": "chain length", "orderings": orderings, "n": int(found["n"])}
            cells |= {"success": float(length["mean"]), "ci95_low": float(low), "ci95_high": float(high)}
            yield cells | {"std": length["std"]}
    for k, segment in enumerate(results.get("by_segment", ())):
        yield {"part": f"segment {k + 1}"} | _rate(segment)


def policy_name(policy: str) -> str:
    """A policy in short: run and step of a checkpoint, such as `eer 0102400`; a Hub id as it is."""
    parts = Path(policy).parts
    if "checkpoints" not in parts[:-1]:
        return "/".join(parts[-2:])
    place = len(parts) - 1 - parts[::-1].index("checkpoints")
    run = parts[:place]
    name = "/".join(run[-3:-1]) if run and run[-1] == "train" else "/".join(run[-1:])
    return f"{name} {parts[place + 1]}"


def _add_runs(evaluations: pd.DataFrame) -> None:
    """Add the run's columns to the evaluations of its checkpoints; other evaluations are named by their policy."""
    evaluations[IDENTITY] = evaluations[IDENTITY].astype(object)
    own = evaluations[evaluations["source"] == TRAIN]
    for i, one in evaluations[evaluations["source"] != TRAIN].iterrows():
        run = own[own["folder"] == one["trained_in"]]
        if len(run):
            evaluations.loc[i, IDENTITY] = run.iloc[0][IDENTITY]
            at = run[run["steps"] == one["steps"]]["interventions"]
            evaluations.loc[i, "interventions"] = at.iloc[-1] if len(at) else np.nan
        else:
            evaluations.loc[i, "row"] = one["policy"]
    # Whole numbers again, beside evaluations that have no seed.
    evaluations["seed"] = evaluations["seed"].convert_dtypes()
    twice = evaluations.duplicated(["source", "policy", "suite", "split"], keep=False) & (
        evaluations["source"] != TRAIN
    )
    folders = evaluations.loc[twice, "path"].map(lambda path: Path(path).parents[1].name)
    evaluations.loc[twice, "policy"] += " (" + folders + ")"
