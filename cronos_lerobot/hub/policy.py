"""The repository of a policy: the checkpoint as LeRobot wrote it, a card, and curves."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from lerobot.utils.constants import (
    ACTION,
    POLICY_POSTPROCESSOR_DEFAULT_NAME,
    POLICY_PREPROCESSOR_DEFAULT_NAME,
)
from lerobot_env_cronos import get_scene
from lerobot_env_cronos.simulation.simulation import ACTION_NAMES
from matplotlib.figure import Figure
from safetensors import SafetensorError, safe_open

from cronos_lerobot.agents.steering.steered import STEERING
from cronos_lerobot.evaluation.config import EXPERT
from cronos_lerobot.evaluation.policy_env import trained_renderer, trained_scene
from cronos_lerobot.evaluation.policy_source import files_fingerprint
from cronos_lerobot.evaluation.store import read_results
from cronos_lerobot.hub.cards import render_card
from cronos_lerobot.hub.caveats import describe_caveats
from cronos_lerobot.hub.config import PolicyConfig
from cronos_lerobot.hub.eval_flags import cronos_eval_flags, lerobot_eval_flags
from cronos_lerobot.hub.peft_base import find_base, name_base
from cronos_lerobot.hub.runs import (
    Checkpoint,
    config_facts,
    describe_source,
    find_checkpoint,
    is_of_cronos_train,
    is_repository,
    read_run,
    run_facts,
    train_config_path,
)
from cronos_lerobot.report import figures
from cronos_lerobot.report.png import to_png
from cronos_lerobot.report.runs import TrainingRun, group_runs

REPLACES = [
    "curves/*", "config.json", "train_config.json", "model.safetensors", "model.safetensors.index.json",
    "model-*-of-*.safetensors", f"{POLICY_PREPROCESSOR_DEFAULT_NAME}*", f"{POLICY_POSTPROCESSOR_DEFAULT_NAME}*",
    "adapter_config.json", "adapter_model.safetensors", STEERING, "tokenizer.json", "tokenizer.model",
    "tokenizer_config.json", "special_tokens_map.json", "added_tokens.json", "merges.txt", "vocab.json",
    "vocab.txt",
]  # fmt: skip
"""Also what a policy of another kind has left: an actor that steers or adapters would be loaded with this one. No
file that is not a policy's: others may lie beside it."""
LICENSE = "apache-2.0"
"""As LeRobot says of a policy that names none."""
FIGURES = {
    "evaluation": ("Periodic evaluation, with 95 % intervals", figures.evaluation_figure),
    "training": ("Success of the training streams' segments", figures.training_figure),
    "segments": ("The same by segment since the last scene reset, last quarter", figures.segments_figure),
}
DPI = 110


def write_policy_repository(config: PolicyConfig, folder: Path) -> str:
    """Write the tree of a policy's repository into `folder`; returns what it is, in words.

    Raises:
        ValueError: --path is missing, the policy is damaged or of another robot, its adapters are of a policy
            that is not on the Hub, or results.json is none, or of another policy or scene.
        FileNotFoundError: there is no policy, or no results.json.
    """
    if config.path is None:
        raise ValueError("--path=<run folder or checkpoint> is required")
    checkpoint = find_checkpoint(config.path)
    policy = _read_policy(checkpoint.model)
    adapters_of = find_base(checkpoint.model, config.base_policy)
    for file in sorted(checkpoint.model.iterdir()):
        if file.is_file():
            shutil.copyfile(file, folder / file.name)
    if adapters_of is not None:
        name_base(folder, adapters_of)
    run = read_run(checkpoint.run, checkpoint.step) if checkpoint.run else None
    curves = _draw_curves(run, folder) if run else []
    results = _read_scores(config.results, checkpoint) if config.results else None
    (folder / "README.md").write_text(_card(config, checkpoint, policy, adapters_of, run, curves, results))
    steps = f" after {run.last['interaction_steps']} interaction steps" if run else ""
    return f"{policy['type']} policy{steps}"


def _read_scores(path: Path, checkpoint: Checkpoint) -> dict[str, Any]:
    """Results of `cronos-eval` of this policy.

    Raises:
        FileNotFoundError: there are none.
        ValueError: they are of the expert, or of a policy with other weights.
    """
    results = read_results(path)
    evaluated = results.get("policy")
    # Results of before there was a hash of the files alone are taken at their word.
    files = results.get("policy_files")
    if evaluated == EXPERT or (files and files != files_fingerprint(checkpoint.model, with_base=False)):
        raise ValueError(f"--results={path} is of {evaluated}, whose weights are not those of {checkpoint.model}")
    return results


def _read_policy(model: Path) -> dict[str, Any]:
    """config.json of a policy whose files are whole and which moves this robot.

    Raises:
        ValueError: names the file that is damaged, or says what the policy is.
    """
    try:
        policy = json.loads((model / "config.json").read_text())
        actions = policy["output_features"][ACTION]["shape"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{model / 'config.json'} is no policy's configuration: {error!r}") from error
    if list(actions) != [len(ACTION_NAMES)]:
        raise ValueError(
            f"the policy in {model} has actions {actions}, those of the WidowX are {len(ACTION_NAMES)}"
        )
    for file in sorted(model.glob("*.safetensors")):
        try:
            with safe_open(file, "numpy") as tensors:
                tensors.keys()
        except SafetensorError as error:
            raise ValueError(f"{file} is damaged: {error}") from error
    return policy


def _draw_curves(run: TrainingRun, folder: Path) -> list[tuple[str, str]]:
    """Draw what there is to draw; returns (caption, path) of each."""
    groups = group_runs([run])
    drawn = []
    for name, (caption, draw) in FIGURES.items():
        figure: Figure | None = draw(groups)
        if figure is None:
            continue
        path = folder / "curves" / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(to_png(figure, DPI))
        drawn.append((caption, f"curves/{name}.png"))
    return drawn


def _card(
    config: PolicyConfig,
    checkpoint: Checkpoint,
    policy: dict[str, Any],
    adapters_of: str | None,
    run: TrainingRun | None,
    curves: list[tuple[str, str]],
    results: dict[str, Any] | None,
) -> str:
    trained = json.loads(train_config_path(checkpoint.model).read_text()) if _has_config(checkpoint) else {}
    copied = config_facts(trained) if is_of_cronos_train(trained) else None
    training = run_facts(run) if run else copied
    base = (run.config.get("policy") or {}).get("pretrained_path") if run else None
    recorded = (trained.get("record") or trained.get("dataset") or {}).get("repo_id")
    # A folder may be none where the card is made; a run that began with one has noted its fingerprint.
    is_on_hub = run is not None and run.base is None and is_repository(base)
    base_model = config.base_policy or (str(base) if is_on_hub else None) or adapters_of
    env = trained.get("env") or {}
    renderer = trained_renderer(checkpoint.model).get("renderer")
    # A scene of one's own, which may not be registered here, is in the config; that of a clone in its dataset.
    trained_in = env.get("scene") or trained_scene(checkpoint.model).get("scene")
    if config.scene and trained_in and config.scene != trained_in:
        raise ValueError(f"--scene={config.scene}, but the policy was trained in {trained_in}")
    if config.scene and not trained_in:
        get_scene(config.scene)
    scene = trained_in or config.scene or (results or {}).get("scene")
    if results and results["scene"] != scene:
        raise ValueError(f"--results={config.results} is of {results['scene']}, the policy of {scene}")
    return render_card(
        "policy",
        repo_id=config.repo_id,
        policy_type=policy["type"],
        article="An" if policy["type"][0] in "aeiou" else "A",
        inputs=policy.get("input_features") or {},
        outputs=policy.get("output_features") or {},
        training=training,
        run=training if run else None,
        dataset=config.dataset or recorded,
        base_model=base_model,
        base_is_local=base is not None and base_model is None,
        adapters_of=adapters_of,
        license=_license(config, policy, base_model),
        tags=[str(tag) for tag in policy.get("tags") or []],
        is_steered=(checkpoint.model / STEERING).is_file(),
        scene=scene,
        lerobot_eval_flags=lerobot_eval_flags(policy, env, scene, renderer, trained.get("rename_map")),
        cronos_eval_flags=cronos_eval_flags(policy, env, scene, trained.get("rename_map")),
        curves=curves,
        results=results,
        caveats=describe_caveats(results, policy, renderer) if results else [],
        results_source=describe_source(results["benchmark"]["source"]) if results else None,
    )


def _license(config: PolicyConfig, policy: dict[str, Any], base_model: str | None) -> str | None:
    """The license of a policy; None where a base's, which is not known here, may forbid any other."""
    return config.license or policy.get("license") or (None if base_model else LICENSE)


def _has_config(checkpoint: Checkpoint) -> bool:
    return train_config_path(checkpoint.model).is_file()
