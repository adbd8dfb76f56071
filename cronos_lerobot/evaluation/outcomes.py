"""Every single episode of an evaluation by what tells it from others, so that two policies can be paired."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from cronos_lerobot.evaluation.store import COMPARISON, RESULTS, read_results

AGREE = {
    "scene": "scene",
    "environment": "version of the environment",
    "benchmark": "benchmark (configurations, episodes and chains)",
}
"""What two evaluations must have alike to be of the same episodes."""
AGREE_IN_CHAINS = {"advance": "advance", "end_effector_reset": "end_effector_reset"}
"""What the chains must have alike, too."""
BESIDE_PIXELS = ("camera_name", "observation_height", "observation_width", "rename_map", "privileged_state")
"""What a policy from pixels is shown, beside the renderer; fields of an evaluation's identity."""
OBSERVED = (*BESIDE_PIXELS, "task_observation")
"""What a policy is shown."""
WORTH_SAYING = ("temperature", "obs_type", "renderer", *OBSERVED, "versions")
"""What may differ, as it is of the policy or should not matter, but is said."""


def observed(obs_type: str | None, env: Mapping[str, Any], rename_map: Mapping[str, str] | None) -> dict[str, Any]:
    """The fields of OBSERVED, None where there is nothing to say; of a policy from the state most are not."""
    shown = {**env, "rename_map": rename_map} if obs_type == "pixels_agent_pos" else {}
    told = {name: shown.get(name) or None for name in BESIDE_PIXELS}
    task = env.get("task_observation", "none")
    return told | {"task_observation": None if task == "none" else task}


def observed_in(results: Mapping[str, Any]) -> dict[str, Any]:
    """The same of a results.json, whose identity has the task apart, and only where it is shown."""
    identity = results.get("identity") or {}
    env = {
        **(identity.get("env") or {}),
        "task_observation": identity.get("task_observation", "none"),
        # What PocketVLA is shown is for its critic. Earlier versions do not say it.
        "privileged_state": results.get("reads_privileged_state"),
    }
    return observed(results.get("obs_type"), env, identity.get("rename_map"))


class Episode(NamedTuple):
    """A chain of an evaluation; an independent episode is one of a single task."""

    suite: str
    split: str
    number: int
    """Of the task or the ordering."""
    configuration: int
    seed: int
    """Of the action sampling."""


@dataclass(frozen=True)
class Outcomes:
    """What a policy did in an evaluation, episode by episode."""

    policy: str
    """As it was given, or the run's folder."""
    fingerprint: str
    setting: dict[str, Any]
    """The fields of AGREE, AGREE_IN_CHAINS and WORTH_SAYING."""
    lengths: dict[Episode, int]
    """Tasks completed."""
    labels: dict[str, dict[int, str]] = field(default_factory=dict)
    """By suite: the instruction of a task, by its number."""
    chain_tasks: int = 1
    """Tasks of a chain of the sequential suite."""

    @property
    def suites(self) -> list[tuple[str, str]]:
        """Pairs of suite and split that there are episodes of."""
        return list(dict.fromkeys((episode.suite, episode.split) for episode in self.lengths))

    def of(self, suite: str, split: str) -> dict[Episode, int]:
        """The episodes of a suite and split."""
        return {e: length for e, length in self.lengths.items() if (e.suite, e.split) == (suite, split)}


def read_outcomes(path: Path) -> Outcomes:
    """Read the episodes of an evaluation by `cronos-eval`, given its folder or results.json.

    Raises:
        FileNotFoundError: it is not there.
        ValueError: it was stopped early, is damaged, of something else, or of another version of the environments.
    """
    folder = path if path.is_dir() else path.parent
    if (folder / COMPARISON).is_file() and not (folder / RESULTS).is_file():
        raise ValueError(
            f"{folder} was stopped as soon as a decision was made, which makes its difference look larger than it"
            f" is: {COMPARISON} says what was decided; evaluate the policy without --stop_at_error"
        )
    results = read_results(path)
    try:
        return _outcomes(folder, results)
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"the evaluation in {folder} is damaged: {error!r}") from error


def _outcomes(folder: Path, results: Mapping[str, Any]) -> Outcomes:
    lengths = {}
    for name in [name for maker in results["made_by"] for name in maker["parts"]]:
        file = folder / "parts" / f"{name}.json"
        if not file.is_file():
            raise ValueError(f"{folder} has no {file.relative_to(folder)}: it is needed to pair episodes")
        part = json.loads(file.read_text())
        for chain in part["chains"]:
            # Parts of earlier commits do not say it; they had the evaluation's.
            seed = part.get("seed", results["seed"])
            key = (part["suite"], part["split"], chain["number"], chain["configuration"], seed)
            lengths[Episode(*key)] = chain["length"]
    instructions = [list(split["per_task"]) for split in results.get("independent", {}).values()]
    chains = [len(split["positions"]) for split in results.get("sequential", {}).values()]
    setting = {name: results.get(name) for name in (*AGREE, *AGREE_IN_CHAINS, *WORTH_SAYING)}
    benchmark = results["benchmark"]
    setting |= {"environment": benchmark["environment"], "benchmark": benchmark["fingerprint"]}
    setting |= observed_in(results)
    return Outcomes(
        results["policy"],
        results["policy_fingerprint"],
        setting,
        lengths,
        {"independent": dict(enumerate(instructions[0]))} if instructions else {},
        chains[0] if chains else 1,
    )


def what_differs(a: Outcomes, b: Outcomes, suite: str) -> Iterator[str]:
    """What keeps the episodes of two policies from being the same ones: a phrase for each."""
    fields = AGREE | (AGREE_IN_CHAINS if suite == "sequential" else {})
    for name, words in fields.items():
        if a.setting.get(name) != b.setting.get(name):
            yield f"{words}: {a.setting.get(name)} and {b.setting.get(name)}"


def shared_episodes(a: Outcomes, b: Outcomes, suite: str, split: str) -> list[Episode]:
    """The episodes of a suite and split that both have, sorted.

    Raises:
        ValueError: they cannot be paired; the sentence names what differs.
    """
    what = f"{a.policy} and {b.policy} cannot be compared in pairs on {suite} {split}"
    if differences := list(what_differs(a, b, suite)):
        raise ValueError(f"{what}: they differ in {'; '.join(differences)}")
    theirs, ours = a.of(suite, split), b.of(suite, split)
    shared = sorted(theirs.keys() & ours.keys())
    if shared:
        return shared
    seeds = [sorted({episode.seed for episode in some}) for some in (theirs, ours)]
    if seeds[0] != seeds[1] and all(seeds):
        raise ValueError(f"{what}: their action sampling has other seeds: {seeds[0]} and {seeds[1]}")
    raise ValueError(f"{what}: no task or ordering from any configuration is in both")
