"""The repository of a policy: the checkpoint as LeRobot wrote it, a card, and a curve of its training."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from lerobot_env_cronos import get_scene
from safetensors import safe_open

from cronos_lerobot.agents.steering.steered import STEERING
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
from cronos_lerobot.film.png import to_png
from cronos_lerobot.hub.cards import code, interval, render_card
from cronos_lerobot.hub.config import PolicyConfig
from cronos_lerobot.hub.eval_flags import environment_flags
from cronos_lerobot.hub.push import matching
from cronos_lerobot.hub.results import describe_setting, differences
from cronos_lerobot.hub.runs import Checkpoint, changed_flags, find_checkpoint, flatten, is_repository
from cronos_lerobot.hub.stage import read_json, readable, stage, write_text
from cronos_lerobot.protocol.interventions import COUNTED_INTERVENTIONS
from cronos_lerobot.report.figures import evaluation_figure
from cronos_lerobot.report.load import tables_of
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
    "vocab.json", "vocab.txt",
)  # fmt: skip
"""What makes a policy. Nothing else is pushed. A new policy removes what an older one has left of these: an actor
that steers, or adapters, would be loaded with it."""
CURVE = "curves/evaluation.png"
LICENSE = "apache-2.0"
"""Of a policy that names none, as in LeRobot."""
CHECKPOINT, CHECKPOINT_REVISION = "checkpoint", "checkpoint_revision"
"""Fields in which OpenVLA's config.json names what it was built from."""


def write_policy_repository(config: PolicyConfig, folder: Path) -> str:
    """Write the tree of a policy's repository into `folder`; returns what it is, in words.

    Raises:
        ValueError: --path is missing, a file is damaged, the adapters are of a policy that is not on the Hub, or
            --results are of another policy.
        FileNotFoundError: there is no policy, or no results.
    """
    if config.path is None:
        raise ValueError("--path=<run folder or checkpoint> is required")
    checkpoint = find_checkpoint(config.path)
    model = checkpoint.model
    names = matching(sorted(file.name for file in model.iterdir()), FILES)
    base, changes = _adapters_base(model, config.base_policy)
    stage(model, names, folder, changes)
    with damage_named(model):
        for name in (name for name in names if name.endswith(".safetensors")):
            with safe_open(model / name, "numpy"):
                pass
    results = _read_scores(config.results, model) if config.results else []
    policy = read_json(model / "config.json")
    with readable(config.path):
        has_curve = checkpoint.run is not None and _draw_curve(checkpoint.run, folder / CURVE)
        card = _card(config, checkpoint, policy, base, results, CURVE if has_curve else None)
    write_text(folder / "README.md", card)
    steps = f" after {checkpoint.run.last['interaction_steps']} interaction steps" if checkpoint.run else ""
    return f"{policy['type']} policy{steps}"


def _adapters_base(model: Path, base_policy: str | None) -> tuple[str | None, dict[str, dict[str, Any]]]:
    """The repository of the policy that PEFT's adapters in `model` go onto, and the JSON that must say so.

    Raises:
        ValueError: they name a folder, and there is no `base_policy`.
    """
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
    """Results of `cronos-eval` of this policy, one for each suite and split.

    Raises:
        ValueError: they are of other weights.
    """
    results, files = read_evaluation(path), files_fingerprint(model, with_base=False)
    if others := [one["policy"] for one in results if one.get("policy_files") != files]:
        raise ValueError(f"--results={path} is of {others[0]}, whose weights are not those of {model}")
    return results


def _card(
    config: PolicyConfig,
    checkpoint: Checkpoint,
    policy: dict[str, Any],
    adapters_base: str | None,
    results: Sequence[dict[str, Any]],
    curve: str | None,
) -> str:
    model, run = checkpoint.model, checkpoint.run
    file = model / TRAIN_CONFIG_NAME
    trained = read_json(file) if file.is_file() else {}
    scene = config.scene or (trained.get("env") or {}).get("scene") or trained_scene(model).get("scene")
    if config.scene:
        get_scene(config.scene)
    base = config.base_policy or adapters_base or _began_with(trained, run)
    flags = environment_flags(policy, trained, scene, model)
    is_reset_free = all(trained.get(name) for name in ("env", "protocol", "algorithm"))
    return render_card(
        "policy",
        repo_id=config.repo_id,
        curve=curve,
        policy_type=str(policy["type"]),
        tags=[str(tag) for tag in policy.get("tags") or []],
        # The license of another repository, which is not known here, may forbid any other.
        license=config.license or policy.get("license") or (None if base else LICENSE),
        base_model=base,
        is_adapter=adapters_base is not None,
        dataset=config.dataset or (trained.get("record") or trained.get("dataset") or {}).get("repo_id"),
        is_steered=(model / STEERING).is_file(),
        is_reset_free=is_reset_free,
        scene=code(scene) if scene else None,
        evaluate={
            name: [name, f"--policy.path={config.repo_id}", *flags] for name in ("cronos-eval", "lerobot-eval")
        },
        features=list(_features(policy)),
        flags=changed_flags(flatten(trained)) if is_reset_free else [],
        changed=[(code(f"--{name}"), code(values)) for name, values in run.changed.items()] if run else [],
        run=run.last if run else None,
        by_kind=list(_by_kind(run)) if run else [],
        evaluations=list(_evaluations(run)) if run else [],
        scores=[row for one in results for row in _scores(one)],
        settings=list(dict.fromkeys(code(describe_setting(one)) for one in results)),
        differences=list(dict.fromkeys(code(text) for one in results for text in differences(one, policy))),
    )


def _draw_curve(run: TrainingRun, file: Path) -> bool:
    """Draw success over interaction steps and interventions, if there were evaluations."""
    figure = evaluation_figure(tables_of(run).evaluations)
    if figure is None:
        return False
    file.parent.mkdir()
    file.write_bytes(to_png(figure, dpi=110))
    return True


def _began_with(trained: dict[str, Any], run: TrainingRun | None) -> str | None:
    """The repository of the policy that a training began with; None if there was none, or a folder."""
    config = run.config if run else trained
    path = (config.get("policy") or {}).get("pretrained_path")
    # Of a folder, which may not be here, the run has noted a fingerprint.
    return str(path) if is_repository(path) and not (run and run.base) else None


def _features(policy: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    for way in ("input", "output"):
        for name, feature in (policy.get(f"{way}_features") or {}).items():
            yield way, code(name), code(feature["type"]), code(" x ".join(map(str, feature["shape"])))


def _by_kind(run: TrainingRun) -> Iterator[tuple[Any, ...]]:
    """(kind, number, whether it counts)."""
    counted = {kind.name.lower() for kind in COUNTED_INTERVENTIONS}
    for name, number in run.last["interventions_by_kind"].items():
        if number:
            yield code(name.replace("_", " ")), int(number), "yes" if name in counted else "no"


def _evaluations(run: TrainingRun) -> Iterator[tuple[Any, ...]]:
    for one in run.evaluations:
        yield (
            one["interaction_steps"], one["interventions"], interval(one["success"], one["ci95"]), one["n"],
            code(one["split"]), code(one["temperature"]),
        )  # fmt: skip


def _scores(results: dict[str, Any]) -> Iterator[tuple[Any, ...]]:
    """(suite, split, measure, value with interval, n) of a results.json."""
    where = code(results["suite"]), code(results["split"])
    if "positions" not in results:
        yield *where, "success", interval(results["success"], results["ci95"]), results["n"]
        return
    for k, position in enumerate(results["positions"]):
        yield *where, f"SEQ {k}", interval(position["success"], position["ci95"]), int(position["n"])
    length = results["average_chain_length"]
    yield *where, "average chain length", interval(length["mean"], length["ci95"], 2), results["n"]
