"""Reads the run folders of `cronos-train`, and names runs by their settings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from cronos_lerobot.environment_id import check_environment_id
from cronos_lerobot.evaluation.policy_source import PUSHED
from cronos_lerobot.training.run_folder import MANIFEST, METRICS

NOT_THE_EXPERIMENT = (
    "seed", "steps", "output_dir", "job_name", "resume", "record", "wandb", "tensorboard", "torch_threads",
    "log_freq", "save_freq", "save_checkpoint", "keep_checkpoints",
)  # fmt: skip
"""Top-level fields of a training config in which two runs of one experiment may differ."""
AIDS = {"EER": "end_effector_reset", "CL": "curriculum", "LSR": "learned_reset", "HSR": "heuristic_reset"}
"""Columns of the paper's Table 1."""
DESCRIBED = {
    "scene_reset_interval", "extra_resets", "task_order", "num_configurations", "reset_phase", "reset_budget",
    *AIDS.values(),
}  # fmt: skip
"""Fields of a protocol that `describe_protocol` names."""
FEW = 3
"""A label names no more settings than these, beside the protocol's."""

Record = dict[str, Any]


@dataclass
class TrainingRun:
    """A run folder of `cronos-train`."""

    folder: Path
    config: dict[str, Any]
    starts: list[Record]
    """One for each time the run was started, from manifest.json, without those that a later start undid."""
    evaluations: list[Record]
    """Lines of metrics.jsonl, as the next two."""
    updates: list[Record]
    ends: list[Record] = field(default_factory=list)
    """Where a budget ended the run between two updates."""

    @property
    def name(self) -> str:
        """The folder's name, with its parents if it is one of an experiment: ROW/SEED/train."""
        folder = self.folder.resolve()
        return "/".join(folder.parts[-3:-1]) if folder.name == "train" else folder.name

    @property
    def seed(self) -> int | None:
        """The run's seed."""
        return self.config.get("seed")

    @property
    def base(self) -> str | None:
        """Fingerprint of the policy that the run began with; None without one."""
        return self.starts[0].get("policy_fingerprint") if self.starts else None

    @property
    def last(self) -> Record:
        """The latest record, for its counters."""
        return max([*self.updates, *self.evaluations, *self.ends], key=lambda record: record["interaction_steps"])


def read_training_run(folder: Path) -> TrainingRun:
    """Read a run folder. A line that a kill left unfinished is skipped.

    Raises:
        ValueError: the run has no record yet, its manifest is damaged, or it is of another version.
    """
    records = []
    for line in (folder / METRICS).read_text().splitlines():
        with suppress(json.JSONDecodeError):
            records.append(json.loads(line))
    if not records or not all(isinstance(record, dict) and "kind" in record for record in records):
        raise ValueError(f"{folder / METRICS} has no record yet, or it is not of cronos-train")
    manifest = folder / MANIFEST
    try:
        starts = _that_remain(json.loads(manifest.read_text())["starts"])
        config = config_of(starts)
    except (ValueError, KeyError, TypeError, IndexError, AttributeError) as error:
        raise ValueError(f"{manifest} is damaged: {error!r}") from error
    # An environment of another kind has no id.
    if (made_in := starts[0].get("environment", "")) is not None:
        check_environment_id(made_in or None, f"the run in {folder}", "train it again")
    kinds = ([record for record in records if record["kind"] == kind] for kind in ("evaluation", "update", "end"))
    return TrainingRun(folder, config, starts, *kinds)


def _that_remain(starts: list[Record]) -> list[Record]:
    """The first start, and those whose steps no later one has undone by resuming from an earlier checkpoint."""
    began = [start.get("interaction_steps") or 0 for start in starts]
    return [s for i, s in enumerate(starts) if i == 0 or began[i] < min(began[i + 1 :], default=began[i] + 1)]


def config_of(starts: list[Record]) -> dict[str, Any]:
    """The config of a run after these starts, with the policy that it began with."""
    first, last = (starts[place]["config"] for place in (0, -1))
    config = last | ({"policy": first["policy"]} if "policy" in first else {})
    return config | {name: dict(config.get(name) or {}) for name in ("env", "policy", "protocol", "algorithm")}


def group_runs(runs: Sequence[TrainingRun], notes: list[str]) -> dict[str, list[TrainingRun]]:
    """Group runs whose settings differ only in seed and length, by a label that says how the groups differ.

    Of several runs of one seed and base policy, which share their beginning, a group has the longest.

    Args:
        runs: of any experiments.
        notes: takes a sentence for each run that is in no group.
    """
    if not runs:
        return {}
    settings = _settings([_experiment_of(run) for run in runs])
    varying = settings.loc[:, settings.nunique(dropna=False) > 1]
    groups: dict[tuple[str, ...], dict[Any, TrainingRun]] = {}
    for key, run in zip(map(tuple, varying.to_numpy()), runs, strict=True):
        group, which = groups.setdefault(key, {}), (run.seed, run.base) if run.seed is not None else run.folder
        if (other := group.setdefault(which, run)) is not run:
            dropped, kept = sorted((run, other), key=lambda one: one.last["interaction_steps"])
            group[which] = kept
            notes.append(
                f"the run {dropped.folder}: {kept.folder} has the same settings and seed, and is as long or longer"
            )
    others = [name for name in varying if name.removeprefix("protocol.") not in DESCRIBED]
    labels: dict[str, list[TrainingRun]] = {}
    for key, group in groups.items():
        values, members = dict(zip(varying, key, strict=True)), list(group.values())
        label = _label(members, {name: values[name] for name in others}, len(others) < len(values))
        labels[f"{label} ({members[0].folder})" if label in labels else label] = members
    return labels


def _label(members: list[TrainingRun], others: dict[str, str], is_protocol_told: bool) -> str:
    """The protocol and the other settings in which the group differs; its folder if those are many."""
    run = members[0]
    is_alone = len(members) == 1 and not others and not is_protocol_told
    if len(others) > FEW or is_alone:
        return run.name.split("/")[0] if len(members) > 1 else run.name
    told = [f"{name.rpartition('.')[2]}={value}" for name, value in others.items() if value != "nan"]
    protocol = [describe_protocol(run.config["protocol"])] if is_protocol_told or not told else []
    return ", ".join(protocol + told)


def _experiment_of(run: TrainingRun) -> dict[str, Any]:
    """The settings of a run that its seeds share."""
    mine = {name: value for name, value in run.config.items() if name not in NOT_THE_EXPERIMENT}
    if policy := mine.get("policy"):
        mine["policy"] = {name: value for name, value in policy.items() if name not in PUSHED}
    return mine


def _settings(configs: list[dict[str, Any]]) -> pd.DataFrame:
    """A row for each config, a column for each flag, all as text."""
    return pd.json_normalize(configs).map(json.dumps).replace('"', "", regex=True).replace("NaN", "nan")


def describe_protocol(protocol: dict[str, Any]) -> str:
    """A protocol in the words of the paper's Table 1, such as `T = 1280, EER, CL, HSR`.

    Args:
        protocol: of a training config.
    """
    interval = protocol.get("scene_reset_interval")
    words = ["no scene resets" if interval is None else f"T = {interval}"]
    aids = dict(AIDS)
    if interval and interval == protocol.get("task_switch_interval") and not protocol.get("curriculum"):
        # A scene reset at every task switch sends the arm home anyway.
        del aids["EER"]
    if protocol.get("reset_phase", "together") != "together":
        words.append(protocol["reset_phase"])
    words += [word for word, name in aids.items() if protocol.get(name)]
    words += protocol.get("extra_resets") or []
    if protocol.get("task_order", "heuristic") != "heuristic":
        words.append(f"{protocol['task_order']} order")
    if protocol.get("num_configurations") not in (None, 64):
        words.append(f"{protocol['num_configurations']} configuration(s)")
    if (budget := protocol.get("reset_budget")) is not None:
        words.append(f"at most {budget} interventions")
    return ", ".join(words)
