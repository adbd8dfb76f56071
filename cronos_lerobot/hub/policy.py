"""The repository of a policy: the checkpoint as LeRobot wrote it, and a card."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from lerobot_env_cronos import get_scene
from safetensors import safe_open

from cronos_lerobot.agents.steering.steered import STEERING
from cronos_lerobot.bases import OFFICIAL
from cronos_lerobot.evaluation.policy_env import trained_scene
from cronos_lerobot.evaluation.policy_loading import damage_named
from cronos_lerobot.evaluation.policy_source import (
    ADAPTER_CONFIG,
    BASE,
    REVISION,
    files_fingerprint,
    find_base,
)
from cronos_lerobot.evaluation.results import read_evaluation
from cronos_lerobot.hub.cards import changed_flags, render_card
from cronos_lerobot.hub.checkpoint import CRONOS, environment_flags, find_checkpoint, is_repository
from cronos_lerobot.hub.config import PolicyConfig, check_name
from cronos_lerobot.hub.push import matching
from cronos_lerobot.hub.results import TRAINING, describe_setting, differences
from cronos_lerobot.hub.stage import read_json, readable, stage, write_text
from cronos_lerobot.protocol.interventions import COUNTED_INTERVENTIONS
from cronos_lerobot.report.load import policy_name
from cronos_lerobot.report.runs import TrainingRun

FILES = (
    "config.json", TRAIN_CONFIG_NAME, "model.safetensors", "model.safetensors.index.json",
    "model-*-of-*.safetensors", ADAPTER_CONFIG, "adapter_model.safetensors", STEERING,
    *(
        f"{name}*.{kind}"
        for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME)
        for kind in ("json", "safetensors")
    ),
    "generation_config.json", "preprocessor_config.json", "processor_config.json", "tokenizer.json",
    "tokenizer.model", "tokenizer_config.json", "special_tokens_map.json", "added_tokens.json", "merges.txt",
    "vocab.json", "vocab.txt", TRAINING,
)  # fmt: skip
"""What makes a policy, and how it was trained. Nothing else is pushed. A new policy removes what an older one has
left of these: an actor that steers, or adapters, would be loaded with it."""
EVALUATE = ("cronos-eval", "lerobot-eval")
LICENSE = "apache-2.0"
"""Of a policy that names none, as in LeRobot."""
CHECKPOINT, CHECKPOINT_REVISION = "checkpoint", "checkpoint_revision"
"""Fields in which OpenVLA's config.json names what it was built from."""


def write_policy_repository(config: PolicyConfig, folder: Path) -> str:
    """Write the tree of a policy's repository into `folder`; returns what it is, in words."""
    if config.path is None:
        raise ValueError("--path=<run folder or checkpoint> is required")
    if config.base_policy is not None:
        check_name("base_policy", config.base_policy)
    model, run = find_checkpoint(config.path)
    names = matching(sorted(file.name for file in model.iterdir()), FILES)
    base, changes = _adapters_base(model, config.base_policy)
    stage(model, names, folder, changes)
    with damage_named(model):
        for name in (name for name in names if name.endswith(".safetensors")):
            with safe_open(model / name, "numpy"):
                pass
    results = _read_scores(config.results, model) if config.results else []
    policy = read_json(model / "config.json")
    trained = read_json(model / TRAIN_CONFIG_NAME) if TRAIN_CONFIG_NAME in names else {}
    with readable(config.path):
        about = _about(config, policy, trained, model, run)
        about["base_model"] = config.base_policy or base or _began_with(trained, run)
        # The license of another repository, which is not known here, may forbid any other.
        own_license = config.license or policy.get("license")
        about["license"] = own_license or (None if about["base_model"] else LICENSE)
        about["settings"] = list(dict.fromkeys(map(describe_setting, results)))
        about["differences"] = list(dict.fromkeys(text for one in results for text in differences(one, policy)))
        card = render_card("policy", results=results, is_adapter=base is not None, **about)
    write_text(folder / "README.md", card)
    if run:
        write_text(folder / TRAINING, json.dumps(_training(run), indent=4))
    steps = f" after {run.last['interaction_steps']} interaction steps" if run else ""
    return f"{policy['type']} policy{steps}"


def _adapters_base(model: Path, base_policy: str | None) -> tuple[str | None, dict[str, dict[str, Any]]]:
    """The repository of the policy that PEFT's adapters in `model` go onto, and the JSON that must say so."""
    base, here = find_base(model)
    if base is None or (is_repository(base) and here is None):
        return base, {}
    if base_policy is None:
        raise ValueError(
            f"{model} holds adapters of the policy in {base}, a folder: publish that policy first, then give its "
            "repository here, --base_policy=<owner>/<name>"
        )
    changes = {ADAPTER_CONFIG: {BASE: base_policy, REVISION: None}}
    named = read_json(model / "config.json").get(CHECKPOINT)
    if named and not is_repository(named):
        changes["config.json"] = {CHECKPOINT: base_policy, CHECKPOINT_REVISION: None}
    return base_policy, changes


def _read_scores(path: Path, model: Path) -> list[dict[str, Any]]:
    """Results of `cronos-eval` of this policy, one for each suite and split."""
    results, files = read_evaluation(path), files_fingerprint(model, with_base=False)
    if others := [one["policy"] for one in results if one.get("policy_files") != files]:
        raise ValueError(f"--results={path} is of {others[0]}, whose weights are not those of {model}")
    return results


def _about(
    config: PolicyConfig, policy: dict[str, Any], trained: dict[str, Any], model: Path, run: TrainingRun | None
) -> dict[str, Any]:
    """What the card says of the policy and its training."""
    scene = config.scene or (trained.get("env") or {}).get("scene") or trained_scene(model).get("scene")
    if config.scene:
        get_scene(config.scene)
    flags = environment_flags(policy, trained, scene, model)
    world = (trained.get("env") or {}).get("type", CRONOS)
    is_reset_free = all(trained.get(name) for name in ("env", "protocol", "algorithm"))
    return {
        "repo_id": config.repo_id,
        "policy": policy,
        "tags": [str(tag) for tag in policy.get("tags") or []],
        "scene": scene or (world if world != CRONOS else None),
        "plays_in_lerobot": world == CRONOS and not (model / STEERING).is_file(),
        "dataset": config.dataset or (trained.get("record") or trained.get("dataset") or {}).get("repo_id"),
        "is_steered": (model / STEERING).is_file(),
        "is_reset_free": is_reset_free,
        "evaluate": {name: [name, f"--policy.path={config.repo_id}", *flags] for name in EVALUATE},
        "flags": changed_flags(trained) if is_reset_free else {},
        "run": run,
        "counted": [kind.name.lower() for kind in COUNTED_INTERVENTIONS],
    }


def _training(run: TrainingRun) -> dict[str, Any]:
    """What an entry of the leaderboard says of the training."""
    counts = {name: run.last[name] for name in ("interaction_steps", "interventions")}
    base = (run.config.get("policy") or {}).get("pretrained_path")
    name = policy_name(base).removeprefix(f"{OFFICIAL.name}/") if base else None
    return counts | {"seed": run.seed, "base": name, "base_fingerprint": run.base}


def _began_with(trained: dict[str, Any], run: TrainingRun | None) -> str | None:
    """The repository of the policy that a training began with; None if there was none, or a folder."""
    config = run.config if run else trained
    path = (config.get("policy") or {}).get("pretrained_path")
    # Of a folder, which may not be here, the run has noted a fingerprint.
    return str(path) if is_repository(path) and not (run and run.base) else None
