"""Reads the folders of `cronos-train` and `lerobot-eval`."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import CHECKPOINTS_DIR, LAST_CHECKPOINT_LINK, PRETRAINED_MODEL_DIR
from lerobot_env_cronos import check_environment_id, load_benchmark
from lerobot_env_cronos.config import DEFAULT_SCENE

from cronos_lerobot.evaluation.policy_source import PUSHED
from cronos_lerobot.evaluation.store import RESULTS
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.report.lerobot_evaluations import EVAL_INFO, EvaluationRun, read_evaluation_runs
from cronos_lerobot.report.protocol_names import DESCRIBED, describe_protocol
from cronos_lerobot.report.statistics import Rate
from cronos_lerobot.report.suites import SuiteRun, check_results, is_results, read_suite_runs
from cronos_lerobot.training.logging import MANIFEST, METRICS

NOT_THE_EXPERIMENT = (
    "seed", "steps", "output_dir", "job_name", "resume", "record", "wandb", "tensorboard", "torch_threads",
    "log_freq", "save_freq", "save_checkpoint", "keep_checkpoints",
)  # fmt: skip
"""Top-level fields of a training config in which two runs of one experiment may differ."""
STEPS = "steps"
"""The one of them that is the experiment's where a budget is paced over it."""

Evaluation = dict[str, Any]
Update = dict[str, Any]


def agent_metrics(update: Update) -> dict[str, float | None]:
    """What the agent said of a policy update; it stood under `ppo` when there was no other agent."""
    return update.get("agent") or update.get("ppo") or {}


@dataclass
class TrainingRun:
    """A run folder of `cronos-train`."""

    folder: Path
    config: dict[str, Any]
    starts: list[dict[str, Any]]
    """One for each time the run was started, from manifest.json, whose steps are still the run's."""
    evaluations: list[Evaluation]
    updates: list[Update]
    ends: list[dict[str, Any]] = field(default_factory=list)
    """Where a budget ended it between two updates."""

    @property
    def name(self) -> str:
        """The folder's name, with those above it where all runs have the same (`cronos-reproduce`: row/seed)."""
        folder = self.folder.resolve()
        return "/".join(folder.parts[-3:-1]) if folder.name == "train" else folder.name

    @property
    def seed(self) -> int | None:
        """The run's seed."""
        return self.config.get("seed")

    @property
    def base(self) -> str | None:
        """Fingerprint of the policy that it began with; None of runs that did not note it."""
        return self.starts[0].get("policy_fingerprint") if self.starts else None

    @property
    def last(self) -> dict[str, Any]:
        """The latest record, for its counters."""
        return max([*self.updates, *self.evaluations, *self.ends], key=lambda record: record["interaction_steps"])

    @property
    def changed(self) -> dict[str, str]:
        """Flags of the protocol and the agent that a resume changed, with the values that they had in turn."""
        configs = [start.get("config") or {} for start in self.starts]
        flags = [_flatten({part: one.get(part) or {} for part in ("protocol", "algorithm")}) for one in configs]
        # One that a start did not have yet is of another version.
        shared = set.intersection(*map(set, flags)) if flags else set()
        values = {name: list(dict.fromkeys(start[name] for start in flags)) for name in sorted(shared)}
        return {name: ", then ".join(several) for name, several in values.items() if len(several) > 1}

    @property
    def alike(self) -> list[Evaluation]:
        """The evaluations that were made as the last one: a resumed run may have had other `--eval.*` before."""
        return [one for one in self.evaluations if _made(one) == _made(self.evaluations[-1])]

    @property
    def begins_alike(self) -> bool:
        """Whether the first evaluation is of step 0 and made as the last one: else there is no success before."""
        return self.alike[:1] == self.evaluations[:1] and not self._unmeasured

    @property
    def _unmeasured(self) -> int:
        """Steps before the first evaluation: of a run that began with `--eval_freq=0` and was resumed without."""
        return self.evaluations[0]["interaction_steps"] if self.evaluations else 0

    @property
    def left_out(self) -> list[str]:
        """Which evaluations are not among those `alike`, and why, and that there is none of step 0, in words."""
        n = self._unmeasured
        said = [f"the first evaluation of {self.folder} is after {n:,} steps: no before, D or C"] if n else []
        if others := [one for one in self.evaluations if _made(one) != _made(self.evaluations[-1])]:
            settings = dict.fromkeys(_describe_made(one) for one in others)
            text = (
                f"{len(others)} of {len(self.evaluations)} evaluations of {self.folder}: they are of"
                f" {' and of '.join(settings)}, the last one is of {_describe_made(self.evaluations[-1])}"
            )
            said.append(text if n or self.begins_alike else f"{text}; what is left has no before, D or C")
        return said


def _made(evaluation: Evaluation) -> tuple[Any, ...]:
    """What evaluations of one curve have in common; runs have not always noted the temperature."""
    return evaluation["split"], evaluation.get("temperature"), evaluation["n"]


def _describe_made(evaluation: Evaluation) -> str:
    split, temperature, n = _made(evaluation)
    return f"{split}, n={n}" + (f", temperature {temperature}" if temperature is not None else "")


@dataclass
class Group:
    """Runs with the same config but for the seed."""

    label: str
    runs: list[TrainingRun] = field(default_factory=list)


@dataclass
class FoundRuns:
    """What some folders hold."""

    training: list[TrainingRun]
    evaluations: list[EvaluationRun]
    """Those of lerobot-eval."""
    suites: list[SuiteRun]
    """Those of cronos-eval."""
    left_out: list[str]
    """What could not be read, a sentence for each: crashed before its first record, damaged, of version 0. And
    the evaluations of runs that are not `alike`, or missing at step 0."""


def find_runs(folders: Iterable[Path], scene: str | None = None, benchmark: str | None = None) -> FoundRuns:
    """Read the runs of cronos-train, lerobot-eval and cronos-eval in `folders` and below them, each once.

    Args:
        folders: where to look.
        scene: of the evaluations of lerobot-eval, whose files do not name it; that of the runs by default.
        benchmark: of the same; the package's by default.

    Raises:
        FileNotFoundError: a folder is missing or holds no run.
        ValueError: of all that they hold nothing can be read, or there is no such scene or benchmark.
    """
    training: dict[Path, TrainingRun] = {}
    evaluation: dict[Path, list[EvaluationRun]] = {}
    suites: dict[Path, None] = {}
    numbered: list[Path] = []
    left_out: dict[Path, str] = {}

    def keep(table: dict[Path, Any], path: Path, read: Callable[[], Any]) -> None:
        if path in table or path in left_out:
            return
        try:
            table[path] = read()
        except (ValueError, KeyError, TypeError, OSError) as error:
            text = str(error) if str(path.parent) in str(error) else f"{path} is damaged: {error!r}"
            left_out[path] = " ".join(text.split())

    for folder in folders:
        files = {
            name: [path.resolve() for path in files_called(folder, name)] for name in (METRICS, EVAL_INFO, RESULTS)
        }
        for path in files[METRICS]:
            keep(training, path, lambda path=path: read_training_run(path.parent))
        numbered += files[EVAL_INFO]
        results = [path for path in files[RESULTS] if is_results(path)]
        for path in results:
            keep(suites, path, lambda path=path: check_results(path))
        if not files[METRICS] and not files[EVAL_INFO] and not results:
            raise FileNotFoundError(
                f"{folder} has no {METRICS} of cronos-train, no {RESULTS} of cronos-eval and no {EVAL_INFO} of"
                " lerobot-eval."
            )
    scene = scene or scene_of(training.values())
    if numbered:
        # What is wrong with it is not the folders' fault.
        load_benchmark(benchmark, scene)
    for path in numbered:
        keep(evaluation, path, lambda path=path: read_evaluation_runs(path.parent, scene, benchmark))
    if left_out and not (training or evaluation or suites):
        raise ValueError("; ".join(left_out.values()))
    evaluations = [run for runs in evaluation.values() for run in runs]
    said = [*left_out.values(), *(text for run in training.values() for text in run.left_out)]
    return FoundRuns(list(training.values()), evaluations, read_suite_runs(suites), said)


def scene_of(runs: Iterable[TrainingRun]) -> str:
    """The scene of all of them; the default one if they are of several, or say none."""
    scenes = {str(env["scene"]) for run in runs if (env := run.config.get("env") or {}).get("scene")}
    return scenes.pop() if len(scenes) == 1 else DEFAULT_SCENE


def files_called(folder: Path, name: str) -> Iterator[Path]:
    """Files of a name in a folder, or else below it."""
    own = folder / name
    return iter([own] if own.is_file() else sorted(folder.rglob(name)))


def read_training_run(folder: Path) -> TrainingRun:
    """Read a run folder; a line that a kill left unfinished is skipped.

    Raises:
        ValueError: it has no record yet, its manifest is damaged, or another version of the environments made it.
    """
    records = []
    for line in (folder / METRICS).read_text().splitlines():
        with suppress(json.JSONDecodeError):
            records.append(json.loads(line))
    if wrong := [line for line in records if not isinstance(line, dict) or "kind" not in line]:
        raise ValueError(f"{folder / METRICS} is not of cronos-train: it has the record {str(wrong[0])[:80]}")
    if not records:
        raise ValueError(f"{folder / METRICS} has no record yet: the run has not come to its first evaluation.")
    manifest = folder / MANIFEST
    try:
        starts = _that_remain(json.loads(manifest.read_text())["starts"]) if manifest.is_file() else []
    except ValueError as error:
        raise ValueError(f"{manifest} is damaged: {error}") from error
    # Null is an environment of another kind.
    if starts and (made_in := starts[0].get("environment", "")) is not None:
        check_environment_id(made_in or None, f"the run in {folder}", "train it anew")
    return TrainingRun(
        folder,
        config_of(folder, starts),
        starts,
        *([record for record in records if record["kind"] == kind] for kind in ("evaluation", "update", "end")),
    )


def _that_remain(starts: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The first, and those whose steps no later one has taken anew, from an earlier checkpoint."""
    began = [start.get("interaction_steps") for start in starts]
    least = [min((n for n in began[i + 1 :] if n is not None), default=None) for i in range(len(began))]
    return [s for s, n, low in zip(starts, began, least, strict=True) if not n or low is None or low > n]


def config_of(folder: Path, starts: list[dict[str, Any]]) -> dict[str, Any]:
    """The config of a run in `folder` after these starts."""
    if starts:
        config = starts[-1]["config"]
        # A resumed run names its own checkpoint; what it began with is the experiment.
        first = starts[0]["config"]
        return config | {"policy": first["policy"]} if "policy" in first else config
    path = folder / CHECKPOINTS_DIR / LAST_CHECKPOINT_LINK / PRETRAINED_MODEL_DIR / TRAIN_CONFIG_NAME
    return json.loads(path.read_text()) if path.is_file() else {}


def _below_root(config: dict[str, Any]) -> dict[str, Any]:
    """A config with the path of `cronos-reproduce`'s base policy as seen from its root, which may be moved.

    That is base/<recipe>/clone; what else is called base in two folders may be two policies.
    """
    policy = config.get("policy") or {}
    found = re.search(r"(?:^|/)(base/[^/]+/clone(?:/.*)?)$", policy.get("pretrained_path") or "")
    return config | {"policy": policy | {"pretrained_path": found[1]}} if found else config


def _with_defaults(config: dict[str, Any]) -> dict[str, Any]:
    """A config with the flags of the protocol that it is too old for, whose defaults are what was done before."""
    if "protocol" not in config:
        return config
    return config | {"protocol": draccus.encode(ProtocolConfig()) | config["protocol"]}


def _experiment_of(run: TrainingRun) -> dict[str, Any]:
    """The config of a run without what its seeds and longer runs may have otherwise."""
    mine = {name: value for name, value in run.config.items() if name not in NOT_THE_EXPERIMENT}
    if policy := mine.get("policy"):
        mine["policy"] = {name: value for name, value in policy.items() if name not in PUSHED}
    config = _below_root(_with_defaults(mine))
    protocol = config.get("protocol") or {}
    # A longer run spends its budget more slowly: it does not begin with the shorter one.
    is_paced = protocol.get("scene_reset") == "critic" or protocol.get("takeover_budget") is not None
    return config | {STEPS: run.config.get(STEPS)} if is_paced else config


def group_runs(runs: list[TrainingRun], notes: list[str] | None = None) -> list[Group]:
    """Group runs by their config but for seed and length, labelled by what tells the groups apart.

    A run that was resumed with other flags of the protocol or the agent is of its own kind, as its label says.
    Of several runs of one seed from one policy a group has the longest.

    Args:
        runs: of any experiments.
        notes: takes a sentence for each run that is in no group.
    """
    groups: dict[str, Group] = {}
    flat = {}
    for run in runs:
        config = _experiment_of(run)
        key = json.dumps([config, run.changed], sort_keys=True) if config else str(run.folder)
        _add_run(groups.setdefault(key, Group("")), run, notes)
        flat[key] = _flatten(config)
    differing = _find_differing(flat.values())
    others = [name for name in differing if name not in DESCRIBED]
    for key, group in groups.items():
        group.label = _shared_name(group.runs)
        # Where one group is all there is, the name of one of its runs would stand for all of them.
        is_alone = len(groups) == 1 and len(group.runs) > 1 and "protocol" in group.runs[0].config
        if is_alone or (differing and len(others) <= 3):
            protocol = (
                describe_protocol(group.runs[0].config["protocol"]) if is_alone or others != differing else ""
            )
            group.label = ", ".join(filter(None, (protocol, _name_values(flat[key], others))))
        if changed := group.runs[0].changed:
            group.label += f" (resumed with {_name_values(changed, list(changed))})"
    for label, count in Counter(group.label for group in groups.values()).items():
        if count > 1:
            _tell_apart({key: group for key, group in groups.items() if group.label == label}, flat)
    return list(groups.values())


def _add_run(group: Group, run: TrainingRun, notes: list[str] | None) -> None:
    """Add a run to its group, or keep the longer of it and one of the same seed."""
    # A longer run of the same seed begins with the shorter one: counted twice it would narrow the spread.
    same = next((other for other in group.runs if _are_of_one_seed(run, other)), None)
    if same is None:
        group.runs.append(run)
        return
    dropped, kept = sorted((run, same), key=lambda one: one.last["interaction_steps"])
    group.runs[group.runs.index(same)] = kept
    if notes is not None:
        steps, more = (one.last["interaction_steps"] for one in (dropped, kept))
        notes.append(
            f"the run {dropped.folder}, of {steps:,} steps: {kept.folder} is of the same settings and seed and has"
            f" {more:,}"
        )


def _shared_name(runs: list[TrainingRun]) -> str:
    """The words that the names of runs begin with, such as `t80` of `t80/seed1`; all names where there is none."""
    if len(runs) == 1:
        return runs[0].name
    shared = ""
    for words in zip(*(re.split(r"([/._-])", run.name) for run in runs), strict=False):
        if len(set(words)) > 1:
            break
        shared += words[0]
    return shared.rstrip("/._-") or ", ".join(run.name for run in runs)


def _find_differing(configs: Iterable[dict[str, str]]) -> list[str]:
    """Settings that are not the same in all of these; of `steps` those count that a budget is paced over."""
    configs = list(configs)
    values = {name: {config.get(name) for config in configs} for config in configs for name in config}
    values.get(STEPS, set()).discard(None)
    return sorted(name for name, several in values.items() if len(several) > 1)


def _tell_apart(alike: dict[str, Group], flat: dict[str, dict[str, str]]) -> None:
    """Add to one label of several groups what words do not say, or where that is too much their folders."""
    differing = _find_differing(flat[key] for key in alike)
    for key, group in alike.items():
        is_short = 0 < len(differing) <= 3
        group.label += f" ({_name_values(flat[key], differing) if is_short else group.runs[0].folder})"


def _are_of_one_seed(run: TrainingRun, other: TrainingRun) -> bool:
    """Whether one run may be the beginning of the other: from another machine's clone a seed is another run."""
    bases = {run.base, other.base}
    return run.seed is not None and run.seed == other.seed and (len(bases) == 1 or None in bases)


def _name_values(config: dict[str, str], names: list[str]) -> str:
    told = [name for name in names if name != STEPS or name in config]
    return ", ".join(f"{name.split('.')[-1]}={config.get(name)}" for name in told)


def _flatten(config: dict[str, Any], prefix: str = "") -> dict[str, str]:
    flat: dict[str, str] = {}
    for name, value in config.items():
        if isinstance(value, dict):
            flat |= _flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = json.dumps(value).strip('"')
    return flat


def evaluation_rates(evaluation: Evaluation) -> dict[str, Rate]:
    """Success by instruction, of an evaluation that `cronos-train` logged."""
    return {task: Rate(round(r["success"] * r["n"]), r["n"]) for task, r in evaluation["per_task"].items()}
