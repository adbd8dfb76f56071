"""The two sides of `cronos-report compare`: which policies a folder stands for, and what they did."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from lerobot.utils.constants import OBS_ENV_STATE

from cronos_lerobot.evaluation.outcomes import (
    AGREE_IN_CHAINS,
    WORTH_SAYING,
    Episode,
    Outcomes,
    observed,
    read_outcomes,
    shared_episodes,
)
from cronos_lerobot.evaluation.store import COMPARISON, RESULTS
from cronos_lerobot.report.comparisons import at_their_end
from cronos_lerobot.report.runs import TrainingRun, files_called, group_runs, read_training_run
from cronos_lerobot.report.suites import is_results, policy_name
from cronos_lerobot.training.logging import METRICS

LAST = "last"


@dataclass(frozen=True)
class Side:
    """Some policies: one, or trainings of one kind that differ in their seed."""

    folders: tuple[Path, ...]
    evaluations: list[Outcomes]
    """Of cronos-eval."""
    runs: list[Outcomes] = field(default_factory=list)
    """The last periodic evaluations of cronos-train."""
    notes: list[str] = field(default_factory=list)
    """What was left out, a sentence for each."""

    @property
    def suites(self) -> list[tuple[str, str]]:
        """Pairs of suite and split that there are episodes of."""
        return list(dict.fromkeys(pair for o in (*self.evaluations, *self.runs) for pair in o.suites))

    def trainings(self, suite: str, split: str) -> list[Outcomes]:
        """One for each policy, of several checkpoints of one run the last.

        As cronos-eval found it, wherever that was run, unless more of the side's runs have an evaluation of their
        own, or a later one.

        Raises:
            ValueError: a policy has two evaluations of the same episodes, or one name is of two policies.
        """
        evaluated, own = self._by_source(suite, split)
        return own if len(evaluated) < len(own) else evaluated

    def passed_over(self, suite: str, split: str) -> str | None:
        """Which evaluations `trainings` does not speak of, in words; None if there are none."""
        evaluated, own = self._by_source(suite, split)
        words = []
        if early := [str(_checkpoint(one)[1]) for one in self._outdated(suite, split)]:
            end = max(step for _, step in map(_checkpoint, self.runs) if isinstance(step, int))
            words.append(f"cronos-eval of checkpoint {', '.join(early)}, the runs' own evaluations go to {end}")
        if 0 < len(evaluated) < len(self.runs):
            counts = f"cronos-eval has been run of {len(evaluated)} of {len(self.runs)} policies"
            has_all = len(evaluated) < len(own)
            words.append(f"{counts}: all have their runs' own evaluations here" if has_all else counts)
        return "; ".join(words) or None

    def _by_source(self, suite: str, split: str) -> tuple[list[Outcomes], list[Outcomes]]:
        outdated = self._outdated(suite, split)
        current = [one for one in self.evaluations if one not in outdated]
        return _by_policy(current, suite, split), _by_policy(self.runs, suite, split)

    def _outdated(self, suite: str, split: str) -> list[Outcomes]:
        """Evaluations of cronos-eval of checkpoints before the end of the runs, which have their own there.

        A run is known by its folder; where that has moved, an end before those of all is an early one.
        """
        ends = {run: step for run, step in map(_checkpoint, self.runs) if isinstance(step, int)}
        if not all(one.of(suite, split) for one in self.runs) or not ends:
            return []
        found = []
        for one in self.evaluations:
            run, step = _checkpoint(one)
            if isinstance(step, int) and one.of(suite, split) and step < ends.get(run, min(ends.values())):
                found.append(one)
        return found


def _by_policy(outcomes: Sequence[Outcomes], suite: str, split: str) -> list[Outcomes]:
    """The episodes of each policy; of each run its last checkpoint."""
    found: dict[str, dict[str, Outcomes]] = {}
    for one in outcomes:
        if lengths := one.of(suite, split):
            run, checkpoint = run_and_checkpoint(one)
            _add(found.setdefault(run, {}), checkpoint, replace(one, lengths=lengths))
    _check_spelled_alike(run for run, checkpoints in found.items() if "" not in checkpoints)
    policies: dict[str, Outcomes] = {}
    for run, checkpoints in found.items():
        if LAST in checkpoints and len(checkpoints) > 1:
            raise ValueError(
                f"{run} has evaluations of {LAST} and of {', '.join(sorted(checkpoints.keys() - {LAST}))}, and"
                " which is the later is not known: name the folder of the one that is meant"
            )
        last = checkpoints[max(checkpoints, key=_order)]
        _add(policies, identity(last), last)
    return list(policies.values())


def _check_spelled_alike(runs: Iterable[str]) -> None:
    """A ValueError if one run may be two, as its folder was named from here and from elsewhere."""
    paths = {Path(run) for run in runs}
    for short in paths:
        for path in paths - {short}:
            if not short.is_absolute() and path.parts[-len(short.parts) :] == short.parts:
                raise ValueError(
                    f"{short} and {path} may be one training, which would count twice: name folders of "
                    "evaluations that call it alike"
                )


def _add(found: dict[str, Outcomes], key: str, one: Outcomes) -> None:
    found[key] = _together(found[key], one) if key in found else one


def identity(outcomes: Outcomes) -> str:
    """What tells a policy, as it was evaluated, from another, wherever it lies."""
    return f"{outcomes.fingerprint or outcomes.policy} {_setting(outcomes)}"


def is_same(one: Outcomes, other: Outcomes) -> bool:
    """Whether two are of one policy, evaluated alike; a run's own evaluation, by its checkpoint."""
    if one.fingerprint and other.fingerprint:
        return identity(one) == identity(other)
    return _checkpoint(one) == _checkpoint(other) and _setting(one) == _setting(other)


def _setting(outcomes: Outcomes) -> list[tuple[str, str]]:
    return sorted((name, str(outcomes.setting.get(name))) for name in WORTH_SAYING)


def _checkpoint(outcomes: Outcomes) -> tuple[str, int | str]:
    """The run and the checkpoint, whatever they are called: `last` is where it leads to."""
    run, checkpoint = run_and_checkpoint(outcomes)
    if not checkpoint:
        return run, ""
    folder = (Path(run) / "checkpoints" / checkpoint).resolve()
    return str(folder.parent), int(folder.name) if folder.name.isdigit() else folder.name


def _order(checkpoint: str) -> tuple[int, str]:
    return int(checkpoint) if checkpoint.isdigit() else -1, checkpoint


def run_and_checkpoint(outcomes: Outcomes) -> tuple[str, str]:
    """The run that a policy is of, and its checkpoint; a policy that is of none stands for itself."""
    parts = Path(outcomes.policy).parts
    if "checkpoints" not in parts[:-1]:
        return f"{outcomes.policy} {outcomes.fingerprint}", ""
    place = len(parts) - 1 - parts[::-1].index("checkpoints")
    return str(Path(*parts[:place])), parts[place + 1]


def _together(one: Outcomes, other: Outcomes) -> Outcomes:
    """Evaluations of a policy with other seeds, or of other episodes."""
    if one.fingerprint != other.fingerprint:
        raise ValueError(
            f"{one.policy} was evaluated as two different policies ({one.fingerprint} and {other.fingerprint}):"
            " name the folders of one of them"
        )
    names = [name for name in one.setting if one.setting[name] != other.setting[name]]
    differ = "; ".join(f"{name}: {one.setting[name]} and {other.setting[name]}" for name in names)
    if one.lengths.keys() & other.lengths.keys():
        raise ValueError(
            f"{one.policy} has two evaluations of the same episodes ({differ or 'made alike'}): name the folder of"
            " the one that is meant"
        )
    chains = any(episode.suite == "sequential" for episode in one.lengths)
    if any(chains or name not in AGREE_IN_CHAINS for name in names if name != "versions"):
        raise ValueError(
            f"{one.policy} has evaluations that were not made alike ({differ}): name the folders of those that are"
            " meant"
        )
    return replace(one, lengths=one.lengths | other.lengths)


def read_side(folders: Sequence[Path]) -> Side:
    """Read what `cronos-eval` and `cronos-train` wrote into some folders and below them.

    Raises:
        FileNotFoundError: a folder is missing or holds nothing of theirs.
        ValueError: nothing in them can be paired, or they hold runs of several experiments.
    """
    evaluations: dict[Path, Outcomes] = {}
    runs: dict[Path, TrainingRun] = {}
    notes: list[str] = []
    for folder in folders:
        results = [path for path in files_called(folder, RESULTS) if is_results(path)]
        stopped = [path for path in files_called(folder, COMPARISON) if not (path.parent / RESULTS).is_file()]
        metrics = list(files_called(folder, METRICS))
        if not results and not metrics and not stopped:
            raise FileNotFoundError(f"{folder} has no {RESULTS} of cronos-eval and no {METRICS} of cronos-train")
        for path in (*results, *stopped):
            if path.resolve() not in evaluations:
                _keep(notes, lambda path=path: evaluations.setdefault(path.resolve(), read_outcomes(path.parent)))
        for path in metrics:
            if path.resolve() not in runs:
                _keep(notes, lambda path=path: runs.setdefault(path.resolve(), read_training_run(path.parent)))
    groups = group_runs(list(runs.values()), notes)
    if len(groups) > 1:
        labels = "; ".join(group.label for group in groups)
        raise ValueError(f"{_names(folders)}: runs of {len(groups)} experiments, not seeds of one: {labels}")
    own: list[Outcomes] = []
    for run in at_their_end(groups[0].runs, notes) if groups else []:
        _keep(notes, lambda run=run: own.append(last_evaluation(run)))
    if not evaluations and not own:
        raise ValueError("; ".join(notes))
    return Side(tuple(folders), list(evaluations.values()), own, notes)


def _keep(notes: list[str], read: Any) -> None:
    try:
        read()
    except (ValueError, OSError) as error:
        notes.append(" ".join(str(error).split()))


def _names(folders: Sequence[Path]) -> str:
    return ", ".join(map(str, folders))


def last_evaluation(run: TrainingRun) -> Outcomes:
    """The episodes of a run's last periodic evaluation.

    Raises:
        ValueError: see `periodic_evaluation`.
    """
    return periodic_evaluation(run, -1)


def periodic_evaluation(run: TrainingRun, number: int) -> Outcomes:
    """The episodes of one of a run's own evaluations, by its place: 0 is the base policy's, -1 the last.

    Raises:
        ValueError: there is none, or it was made before episodes were kept.
    """
    evaluation = run.evaluations[number] if run.evaluations else {}
    if not evaluation.get("episodes"):
        which = {0: "first", -1: "last"}[number]
        raise ValueError(
            f"{run.folder}: its {which} evaluation does not say how each episode ended; evaluate its {which}"
            " checkpoint with cronos-eval"
        )
    start = run.starts[-1] if run.starts else {}
    env, policy = dict(run.config.get("env") or {}), run.config.get("policy") or {}
    # What PocketVLA is shown is for its critic.
    is_read = OBS_ENV_STATE in (policy.get("input_features") or {}) and "critic_observation" not in policy
    env["privileged_state"] = env.get("privileged_state") and is_read
    setting = observed(env.get("obs_type"), env, run.config.get("rename_map")) | {
        "scene": env.get("scene"),
        "environment": start.get("environment"),
        "benchmark": (start.get("benchmark") or {}).get("fingerprint"),
        # A single task has no next one.
        "advance": None,
        "end_effector_reset": None,
        "temperature": evaluation["temperature"],
        "obs_type": env.get("obs_type"),
        "renderer": env.get("renderer"),
        "versions": start.get("versions"),
    }
    lengths = {
        Episode("independent", evaluation["split"], number, configuration, seed): success
        for seed, number, configuration, success in evaluation["episodes"]
    }
    policy = run.folder.resolve() / "checkpoints" / f"{evaluation['interaction_steps']:07d}" / "policy"
    labels = {"independent": dict(enumerate(evaluation["per_task"]))}
    return Outcomes(str(policy), "", setting, lengths, labels)


def paired_episodes(sides: Sequence[Sequence[Outcomes]], suite: str, split: str) -> list[Episode]:
    """The episodes that all policies of both sides have, sorted.

    Raises:
        ValueError: two of them cannot be paired; the sentence names what differs.
    """
    policies = [outcomes for side in sides for outcomes in side]
    shared = set(policies[0].lengths)
    for other in policies[1:]:
        shared &= set(shared_episodes(policies[0], other, suite, split))
    if not shared:
        raise ValueError(f"no episode of {suite} {split} was run by all {len(policies)} policies")
    return sorted(shared)


def short_names(policies: Sequence[Outcomes]) -> list[str]:
    """Policies in short; those of one name with the first folder in which they differ."""
    names = [policy_name(one.policy) for one in policies]
    paths = [Path(one.policy).parts for one in policies]
    told = []
    for i, (name, path) in enumerate(zip(names, paths, strict=True)):
        others = [other for j, other in enumerate(paths) if names[j] == name and j != i]
        differing = [part for part, *rest in zip(path, *others, strict=False) if {part} != {*rest}]
        told.append(f"{name} ({differing[0]})" if others and differing else name)
    return told
