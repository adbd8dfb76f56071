"""`.eval_results/cronos.yaml` of a policy's repository: scores for the benchmark's leaderboard on the Hub."""

from __future__ import annotations

import json
from collections.abc import Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import EvalResultEntry, HfApi, eval_result_entries_to_yaml
from huggingface_hub.constants import CONFIG_NAME
from huggingface_hub.errors import RemoteEntryNotFoundError, RevisionNotFoundError
from huggingface_hub.hf_api import RepoFile
from lerobot_env_cronos import Benchmark, gymnasium_id, load_benchmark
from lerobot_env_cronos.benchmark.benchmark import SUITES

from cronos_lerobot.evaluation.config import EXPERT
from cronos_lerobot.evaluation.outcomes import observed_in
from cronos_lerobot.evaluation.store import read_results
from cronos_lerobot.hub.benchmark import task_id
from cronos_lerobot.hub.cards import describe_sampling
from cronos_lerobot.hub.caveats import changes_of_policy
from cronos_lerobot.hub.config import ResultsConfig
from cronos_lerobot.hub.push import PublishError, explained

FILE = ".eval_results/cronos.yaml"
DECISIVE = ("config.json", "*.safetensors", "policy_*.json", "adapter_config.json")
"""Files that make a policy."""
STANDARD = {"advance": "window", "end_effector_reset": False}
"""How the benchmark's chains are run; another way is another score."""


def read_own_results(config: ResultsConfig) -> dict[str, Any]:
    """Read results.json of the policy in the repository that the results go to.

    Raises:
        ValueError: --results is missing, or they are of another policy.
        FileNotFoundError: there is none.
    """
    if config.results is None:
        raise ValueError("--results=<results.json of cronos-eval, or its folder> is required")
    results = read_results(config.results)
    check_policy(results, config.repo_id)
    return results


def find_commit(config: ResultsConfig) -> str | None:
    """The commit that the results are written onto: who pushes them names it, as others may push meanwhile.

    Raises:
        PublishError: the policy's repository or the revision is missing.
    """
    with explained(config.target):
        return HfApi().model_info(config.repo_id, revision=_revision(config)).sha


def write_results(config: ResultsConfig, folder: Path, *, results: dict[str, Any], commit: str | None) -> str:
    """Write the repository's results with the new ones among them into `folder`; returns what they are, in words.

    Args:
        config: what to publish.
        folder: to write into.
        results: of `read_own_results`.
        commit: of the repository, whose results and policy are read.

    Raises:
        ValueError: the results are not of this benchmark, or not of all of it.
        PublishError: the policy's repository has other weights now than were evaluated, or its results cannot be
            read.
    """
    with explained(config.target):
        _check_commit(results, config.repo_id, commit)
        policy = _read_policy(config.repo_id, results["policy_revision"])
    benchmark = _load(config, results)
    entries = make_entries(results, benchmark, config, changes_of_policy(results, policy))
    content = merge(_published(config, commit), eval_result_entries_to_yaml(entries))
    path = folder / FILE
    path.parent.mkdir(parents=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110))
    values = ", ".join(f"{entry.task_id} {entry.value:g}" for entry in entries)
    return f"results on {benchmark.source}: {values}"


def check_policy(results: dict[str, Any], repo_id: str) -> None:
    """Check that results are of the policy in the repository that they go to.

    Raises:
        ValueError: they are of the scripted expert, of another policy, or of a folder.
    """
    evaluated = str(results.get("policy") or "")
    if evaluated == EXPERT:
        raise ValueError(f"the results are of the {EXPERT}, not of the policy {repo_id}")
    if evaluated.partition("@")[0] != repo_id:
        raise ValueError(
            f"the results are of {evaluated!r}, not of {repo_id}: evaluate with --policy.path={repo_id}"
        )
    if results.get("policy_revision") is None:
        raise ValueError(
            f"the results are of a folder called {evaluated}, not of the repository: evaluate where there is no"
            " such folder"
        )


def _check_commit(results: dict[str, Any], repo_id: str, commit: str | None) -> None:
    """Check that the policy of the commit that was evaluated is the one that stands at `commit`."""
    evaluated = results["policy_revision"]
    try:
        files = _policy_files(repo_id, evaluated)
    except RevisionNotFoundError as error:
        raise PublishError(
            f"the results are of {repo_id} as it was at {evaluated}, a commit that it no longer has: evaluate it"
            " again, in a new --output_dir"
        ) from error
    if files != _policy_files(repo_id, commit):
        raise PublishError(
            f"the results are of {repo_id} as it was at {evaluated}, which has another policy now: evaluate it"
            " again, in a new --output_dir"
        )


def _policy_files(repo_id: str, revision: str | None) -> dict[str, str]:
    """Hashes of the files that make a policy, by name."""
    files = (one for one in HfApi().list_repo_tree(repo_id, revision=revision) if isinstance(one, RepoFile))
    return {
        one.path: one.lfs.sha256 if one.lfs else one.blob_id
        for one in files
        if any(fnmatch(one.path, pattern) for pattern in DECISIVE)
    }


def _read_policy(repo_id: str, revision: str) -> dict[str, Any]:
    """config.json of the policy in a commit."""
    return json.loads(Path(HfApi().hf_hub_download(repo_id, CONFIG_NAME, revision=revision)).read_text())


def _revision(config: ResultsConfig) -> str | None:
    """The revision that the results are written onto."""
    branches = {branch.name for branch in HfApi().list_repo_refs(config.repo_id).branches}
    return config.branch if config.branch in branches else config.revision


def _load(config: ResultsConfig, results: dict[str, Any]) -> Benchmark:
    """The benchmark's repository, checked to be what was evaluated."""
    evaluated = results["benchmark"]
    name = config.benchmark or evaluated["source"]
    if name.partition("@")[0].count("/") != 1 or Path(name).is_dir():
        raise ValueError(f"--benchmark=<owner>/<repository>[@<revision>] is required; evaluated was {name}")
    benchmark = load_benchmark(name, results["scene"])
    here = {"environment": gymnasium_id(benchmark.scene.name), "fingerprint": benchmark.fingerprint}
    differing = [
        f"{key} {evaluated[key]} was evaluated, {name} has {value}"
        for key, value in here.items()
        if evaluated[key] != value
    ]
    if differing:
        raise ValueError(
            f"the results are not of {name}: {'; '.join(differing)}. Evaluate with --env.benchmark={name}"
        )
    return benchmark


def make_entries(
    results: dict[str, Any], benchmark: Benchmark, config: ResultsConfig, changes: Sequence[str] = ()
) -> list[EvalResultEntry]:
    """An entry for each suite and split of results.json.

    Args:
        results: of results.json.
        benchmark: that was evaluated on.
        config: what to publish.
        changes: that flags of the evaluation made to the policy, in words.

    Raises:
        ValueError: there is nothing to publish, or an evaluation was partial, or of a changed policy, and
            `config.partial` is not set.
    """
    suites = [suite.strip() for suite in config.suites.split(",")]
    if unknown := set(suites) - set(SUITES):
        raise ValueError(f"unknown suites {sorted(unknown)}; valid suites: {list(SUITES)}")
    dataset_id, _, revision = benchmark.source.partition("@")
    entries = []
    for suite in suites:
        for split, scores in results.get(suite, {}).items():
            caveat = _caveat(suite, split, scores["n"], benchmark.size(suite, split), results, changes)
            if caveat and not config.partial:
                raise ValueError(f"{task_id(suite, split)}: {caveat}; --partial=true publishes it all the same")
            entries.append(
                EvalResultEntry(
                    dataset_id=dataset_id,
                    dataset_revision=revision or None,
                    task_id=task_id(suite, split),
                    value=_value(suite, scores),
                    date=results["date"],
                    source_url=config.source_url,
                    notes="; ".join([f"PARTIAL: {caveat}"] * bool(caveat) + _notes(suite, scores, results)),
                )
            )
    if not entries:
        raise ValueError(f"results.json has none of the suites {suites}")
    return entries


def _caveat(suite: str, split: str, n: int, size: int, results: dict[str, Any], changes: Sequence[str]) -> str:
    """In which ways an evaluation is not the benchmark's own, or not of the policy; empty if in none."""
    caveats = []
    repetitions = 1 if suite == "sequential" else results.get("repetitions", 1)
    if n != size * repetitions:
        whole = "chains" if suite == "sequential" else "episodes"
        each = f"{repetitions} times " if repetitions != 1 else ""
        caveats.append(f"{n} of {each}the {size} {whole} of {split} were evaluated")
    if repetitions != 1:
        caveats.append(f"every configuration was run {repetitions} times, the benchmark has each once")
    if renderer := (results.get("identity") or {}).get("renderer"):
        caveats.append(f"the policy saw pictures of the renderer {renderer}, the benchmark's are classic")
    if changes:
        caveats.append(f"flags changed the policy: {', '.join(changes)}")
    other = {name: results[name] for name, value in STANDARD.items() if results[name] != value}
    if suite == "sequential" and other:
        caveats.append(f"evaluated with {other}, the benchmark has {STANDARD}")
    return "; ".join(caveats)


def _value(suite: str, scores: dict[str, Any]) -> float:
    if suite == "sequential":
        return round(scores["average_chain_length"]["mean"], 4)
    return round(100 * scores["success"], 4)


def _notes(suite: str, scores: dict[str, Any], results: dict[str, Any]) -> list[str]:
    """What a reader of the leaderboard needs: size, interval, settings."""
    if suite == "sequential":
        low, high = scores["average_chain_length"]["ci95"]
        positions = ", ".join(f"{100 * position['success']:.1f}" for position in scores["positions"])
        what = [f"average chain length, 95 % interval {low:.2f} to {high:.2f}", f"SEQ 0, 1, ... {positions} %"]
    else:
        low, high = scores["ci95"]
        what = [f"success in %, 95 % interval {100 * low:.1f} to {100 * high:.1f}"]
    how = describe_sampling(results["temperature"])
    versions = results["versions"]
    packages = [
        f"{name} {versions[name]}" for name in ("cronos-lerobot", "lerobot_env_cronos") if name in versions
    ]
    shown = observed_in(results)
    seen = results["obs_type"] + " with the privileged state" * bool(shown["privileged_state"])
    seen += " and the task" * bool(shown["task_observation"])
    return [f"n={scores['n']}", *what, how, f"seed {results['seed']}", seen, ", ".join(packages)]


def _published(config: ResultsConfig, commit: str | None) -> list[dict[str, Any]]:
    """The entries that the repository has at a commit; without a connection an older one of the cache is none."""
    with explained(config.target):
        try:
            path = HfApi().hf_hub_download(config.repo_id, FILE, revision=commit)
        except RemoteEntryNotFoundError:
            return []
    try:
        entries = yaml.safe_load(Path(path).read_text()) or []
    except yaml.YAMLError:
        entries = None
    if not isinstance(entries, list) or not all(
        isinstance(entry, dict) and "dataset" in entry for entry in entries
    ):
        raise PublishError(f"{FILE} of {config.repo_id} is no list of results; mend or delete it first")
    return entries


def merge(there: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Entries with the new ones in the place of older ones of the same benchmark and task, or at the end."""

    def key(entry: dict[str, Any]) -> tuple[Any, Any]:
        return entry["dataset"].get("id"), entry["dataset"].get("task_id")

    latest = {key(entry): entry for entry in new}
    kept = [latest.pop(key(entry), entry) for entry in there]
    return kept + list(latest.values())
