"""`.eval_results/cronos.yaml` of a policy's repository: scores for the benchmark's leaderboard on the Hub."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import EvalResultEntry, HfApi, eval_result_entries_to_yaml
from huggingface_hub.constants import CONFIG_NAME
from huggingface_hub.errors import RemoteEntryNotFoundError, RevisionNotFoundError
from huggingface_hub.hf_api import RepoFile
from lerobot_env_cronos import Benchmark, load_benchmark
from lerobot_env_cronos.benchmark.benchmark import SUITES

from cronos_lerobot.evaluation.policy_source import ADAPTER_CONFIG, UNDECISIVE
from cronos_lerobot.evaluation.results import read_evaluation
from cronos_lerobot.hub.benchmark import task_id
from cronos_lerobot.hub.cards import describe_source
from cronos_lerobot.hub.checkpoint import is_repository
from cronos_lerobot.hub.config import ResultsConfig
from cronos_lerobot.hub.push import PublishError, explained
from cronos_lerobot.hub.stage import clean_json, read_json, readable

FILE = ".eval_results/cronos.yaml"
TRAINING = "cronos_training.json"
"""Steps, interventions, seed and base of a policy's training, which `cronos-publish policy` pushes with it."""
DECISIVE = (CONFIG_NAME, "*.safetensors", "policy_*.json", ADAPTER_CONFIG)
"""Files that make a policy."""
STANDARD = {"advance": "window", "end_effector_reset": False}
"""How the benchmark's chains are run; another way is another score."""
FILLED_IN = (
    *UNDECISIVE, "device", "input_features", "output_features", "use_peft", "checkpoint", "checkpoint_revision",
    "lora_rank", "lora_alpha", "lora_dropout", "lora_targets", "architecture", "action_statistics",
)  # fmt: skip
"""Fields of a policy's config that loading sets: by the machine, the environment, or what it is built from."""


def read_own_results(config: ResultsConfig) -> list[dict[str, Any]]:
    """Read the results, one for each suite and split, and check that they are of the repository's policy."""
    if config.results is None:
        raise ValueError("--results=<output folder of cronos-eval, or a results.json> is required")
    results = read_evaluation(config.results)
    for one in results:
        evaluated = str(one["policy"]).partition("@")[0]
        if evaluated != config.repo_id or one.get("policy_revision") is None:
            raise ValueError(
                f"--results={config.results} is of {evaluated!r}, not of the repository {config.repo_id}: "
                f"evaluate with --policy.path={config.repo_id}, where no folder has that name"
            )
        for name in ("policy_revision", "policy_fingerprint", "benchmark"):
            if one[name] != results[0][name]:
                raise ValueError(f"--results={config.results} has different {name}: publish them one by one")
    return results


def find_commit(config: ResultsConfig) -> str | None:
    """The commit that the results are written onto; others may push meanwhile."""
    api = HfApi()
    with explained(config.repo_id):
        branches = {branch.name for branch in api.list_repo_refs(config.repo_id).branches}
        revision = config.branch if config.branch in branches else config.revision
        return api.model_info(config.repo_id, revision=revision).sha


def write_results(
    config: ResultsConfig, folder: Path, *, results: Sequence[dict[str, Any]], commit: str | None
) -> str:
    """Write the repository's results with the new ones among them into `folder`; returns what they are, in words.

    Args:
        config: what to publish.
        folder: to write into.
        results: of `read_own_results`.
        commit: of the repository, whose results and policy are read.
    """
    evaluated = results[0]["policy_revision"]
    with explained(config.repo_id):
        try:
            is_same = _policy_files(config.repo_id, evaluated) == _policy_files(config.repo_id, commit)
        except RevisionNotFoundError:
            is_same = False
        if not is_same:
            raise PublishError(
                f"the results are of {config.repo_id} at commit {evaluated}, and the repository has another "
                "policy now: evaluate again, with a new --output_dir"
            )
        policy = read_json(Path(HfApi().hf_hub_download(config.repo_id, CONFIG_NAME, revision=evaluated)))
        training = _describe_training(config.repo_id, evaluated)
    benchmark = _load(config, results[0])
    entries = make_entries(results, policy, benchmark, config, training)
    content = merge(_published(config, commit), clean_json(eval_result_entries_to_yaml(entries)))
    path = folder / FILE
    path.parent.mkdir(parents=True)
    path.write_text(yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=110))
    values = ", ".join(f"{entry.task_id} {entry.value:g}" for entry in entries)
    return f"results on {describe_source(benchmark.source)}: {values}"


def _describe_training(repo_id: str, revision: str) -> str:
    """What a policy's repository says of its training; nothing if it has no record of one."""
    try:
        file = Path(HfApi().hf_hub_download(repo_id, TRAINING, revision=revision))
    except RemoteEntryNotFoundError:
        return ""
    with readable(file):
        told = read_json(file)
        counts = f"{told['interaction_steps']:,} steps, {told['interventions']:,} interventions"
        # A base of the Hub has no fingerprint.
        base = f"base {told['base']} {told['base_fingerprint'] or ''}".strip() if told["base"] else "from scratch"
        return f"trained for {counts}, seed {told['seed']}, {base}"


def _policy_files(repo_id: str, revision: str | None) -> dict[str, str]:
    """Hashes of the files that make a policy, by name."""
    files = (one for one in HfApi().list_repo_tree(repo_id, revision=revision) if isinstance(one, RepoFile))
    return {
        one.path: one.lfs.sha256 if one.lfs else one.blob_id
        for one in files
        if any(fnmatch(one.path, pattern) for pattern in DECISIVE)
    }


def _load(config: ResultsConfig, results: Mapping[str, Any]) -> Benchmark:
    """The benchmark's repository, checked to be what was evaluated."""
    evaluated = results["benchmark"]
    name = config.benchmark or str(evaluated.get("source"))
    if not is_repository(name.partition("@")[0]):
        raise ValueError(f"--benchmark=<owner>/<repository>[@<revision>] is required: {name} was evaluated")
    benchmark = load_benchmark(name, results["scene"])
    # The environment and its version are in the fingerprint.
    if evaluated.get("fingerprint") != benchmark.fingerprint:
        raise ValueError(
            f"--benchmark={name} has the fingerprint {benchmark.fingerprint}, {evaluated.get('fingerprint')} was "
            f"evaluated: evaluate with --env.benchmark={name}"
        )
    return benchmark


def make_entries(
    results: Sequence[Mapping[str, Any]],
    policy: Mapping[str, Any],
    benchmark: Benchmark,
    config: ResultsConfig,
    training: str,
) -> list[EvalResultEntry]:
    """An entry for each suite and split to publish.

    Args:
        results: of an evaluation.
        policy: config.json of the policy that was evaluated.
        benchmark: that it was evaluated on.
        config: what to publish.
        training: of the policy, in words.
    """
    suites = [suite.strip() for suite in config.suites.split(",")]
    if unknown := set(suites) - set(SUITES):
        raise ValueError(f"--suites has unknown {sorted(unknown)}; valid: {list(SUITES)}")
    chosen = [one for suite in SUITES for one in results if one["suite"] == suite in suites]
    if not chosen:
        raise ValueError(f"--results has none of the suites {suites}")
    entries = []
    for one in chosen:
        with readable(config.results or Path("results.json")):
            caveat = "; ".join(differences(one, policy, benchmark.size(one["suite"], one["split"])))
            entry = _entry(one, caveat, benchmark.source, config.source_url, training)
        if caveat and not config.partial:
            raise ValueError(f"{entry.task_id}: {caveat}; --partial=true publishes it all the same")
        entries.append(entry)
    return entries


def _entry(
    results: Mapping[str, Any], caveat: str, source: str, source_url: str | None, training: str
) -> EvalResultEntry:
    dataset_id, _, revision = source.partition("@")
    value, notes = _score(results)
    told = [f"PARTIAL: {caveat}"] * bool(caveat) + [f"n={results['n']}", notes]
    told += [training] * bool(training) + [_setting(results)]
    return EvalResultEntry(
        dataset_id=dataset_id,
        dataset_revision=revision or None,
        task_id=task_id(results["suite"], results["split"]),
        value=round(value, 4),
        date=results["date"],
        source_url=source_url,
        notes="; ".join(told),
    )


def _score(results: Mapping[str, Any]) -> tuple[float, str]:
    """The value of the leaderboard, and its interval in words."""
    if results["suite"] == "sequential":
        length = results["average_chain_length"]
        positions = ", ".join(f"{100 * position['success']:.1f}" for position in results["positions"])
        interval = "average chain length, 95 % interval {:.2f} to {:.2f}".format(*length["ci95"])
        return length["mean"], f"{interval}; SEQ 0, 1, ... {positions} %"
    low, high = results["ci95"]
    return 100 * results["success"], f"success in %, 95 % interval {100 * low:.1f} to {100 * high:.1f}"


def _setting(results: Mapping[str, Any]) -> str:
    """How it was evaluated, as far as a reader of the leaderboard needs it."""
    versions = results["versions"]
    packages = [
        f"{name} {versions[name]}" for name in ("cronos-lerobot", "lerobot_env_cronos") if name in versions
    ]
    seen = results["obs_type"] + " with the privileged state" * bool(results["reads_privileged_state"])
    seen += " and the task" * (results["observation"].get("task_observation", "none") != "none")
    return "; ".join(
        [describe_sampling(results["temperature"]), f"sampling seed {results['seed']}", seen, ", ".join(packages)]
    )


def differences(results: Mapping[str, Any], policy: Mapping[str, Any], size: int | None = None) -> list[str]:
    """In which ways results are not of the benchmark's own evaluation, or of the policy as it is published.

    Args:
        results: of a suite and split.
        policy: config.json. A field that it lacks is no difference.
        size: episodes of the suite and split; None takes what the results say.
    """
    found, is_chains = [], results["suite"] == "sequential"
    size = results.get("total", results["n"]) if size is None else size
    if results["n"] != size:
        what = "chains" if is_chains else "episodes"
        found.append(f"{results['n']} of the {size} {what} of {results['split']} were evaluated")
    if results["obs_type"] == "pixels_agent_pos" and (renderer := results["renderer"]) != "classic":
        found.append(f"the policy saw pictures of the renderer {renderer}, the benchmark's are classic")
    if changes := changes_of_policy(results, policy):
        found.append(f"flags changed the policy: {', '.join(changes)}")
    other = {name: results[name] for name, value in STANDARD.items() if results[name] != value}
    if is_chains and other:
        found.append(f"evaluated with {other}, the benchmark has {STANDARD}")
    return found


def changes_of_policy(results: Mapping[str, Any], policy: Mapping[str, Any]) -> list[str]:
    """What `--policy.*` of an evaluation changed, such as `n_action_steps 1 instead of 100`."""
    # A temperature of the evaluation holds whatever the policy's own is.
    ignored = {*FILLED_IN, *(["temperature"] if results["temperature"] is not None else [])}
    return [
        f"{name} {_text(value)} instead of {_text(policy[name])}"
        for name, value in (results.get("policy_config") or {}).items()
        if name in policy and name not in ignored and value != policy[name]
    ]


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)


def describe_sampling(temperature: float | None) -> str:
    """How the actions of an evaluation were drawn, in words."""
    if temperature is None:
        return "the policy's own sampling"
    return f"temperature {temperature}" if temperature else "greedy"


def describe_setting(results: Mapping[str, Any]) -> str:
    """How a suite and split was evaluated, in words."""
    reset = str(results["end_effector_reset"]).lower()
    return (
        f"scene {results['scene']}, benchmark {describe_source(str(results['benchmark']['source']))}, "
        f"{describe_sampling(results['temperature'])}, seed {results['seed']}, advance {results['advance']}, "
        f"end-effector reset {reset}"
    )


def _published(config: ResultsConfig, commit: str | None) -> list[dict[str, Any]]:
    """The entries that the repository has at a commit."""
    with explained(config.repo_id):
        try:
            path = HfApi().hf_hub_download(config.repo_id, FILE, revision=commit)
        except RemoteEntryNotFoundError:
            return []
    try:
        entries = yaml.safe_load(Path(path).read_text()) or []
        if all(isinstance(entry["dataset"], dict) for entry in entries):
            return entries
    except (yaml.YAMLError, UnicodeDecodeError, TypeError, KeyError):
        pass
    raise PublishError(f"{FILE} of {config.repo_id} is no list of results: mend or delete it first")


def merge(there: list[dict[str, Any]], new: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Entries with the new ones instead of older ones of the same benchmark and task, or at the end."""

    def key(entry: dict[str, Any]) -> tuple[str, str]:
        return str(entry["dataset"].get("id")), str(entry["dataset"].get("task_id"))

    latest = {key(entry): entry for entry in new}
    kept = [latest.pop(key(entry), entry) for entry in there]
    return kept + list(latest.values())
