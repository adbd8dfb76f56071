"""What a resumed run takes from the command line: every flag is followed or refused, by one table."""

from __future__ import annotations

import importlib
import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from lerobot.configs import parser
from lerobot.utils.constants import TRAINING_STATE_DIR
from lerobot_env_cronos import CronosEnvConfig, check_environment_id, gymnasium_id, load_benchmark

FOLLOWED, REFUSED = "followed", "refused"

RUN = "run.json"
"""What a checkpoint says of its run: its config, environment and benchmark, how far it is."""
MANIFEST = "manifest.json"
"""What a run's folder says of each time it was started: its command, versions, machine."""

_TABLE = {
    "": {
        FOLLOWED: "resume steps job_name eval_freq eval_at_interventions save_checkpoint save_freq "
        "keep_checkpoints log_freq tensorboard torch_threads wandb.*",
        REFUSED: "output_dir seed num_envs peft.*",
    },
    "env.": {
        FOLLOWED: "num_threads",
        REFUSED: "type scene benchmark obs_type privileged_state task_observation observation_height "
        "observation_width camera_name renderer render_size task suite split advance end_effector_reset fps "
        "max_parallel_tasks disable_env_checker features features_map",
    },
    "policy.": {FOLLOWED: "device push_to_hub repo_id private tags license", REFUSED: "path *"},
    "protocol.": {
        FOLLOWED: "update_interval scene_reset_interval curriculum end_effector_reset heuristic_reset "
        "extra_resets reset_budget reset_phase reset_starts scene_reset critic.* task_order num_configurations "
        "takeover_after takeover_budget takeover_price takeover_expert",
        REFUSED: "task_switch_interval learned_reset reward",
    },
    "algorithm.": {
        FOLLOWED: "epochs value_epochs value_warmup_updates minibatch_size grad_accumulation clip ratio "
        "denoising_discount gamma "
        "gae_lambda normalize_advantage entropy_coef value_coef value_loss huber_delta value_clip policy_lr "
        "value_lr lr_schedule target_kl kl_decay_updates kl_stop_factor lr_factor policy_lr_min policy_lr_max "
        "max_grad_norm "
        "self_imitation.coef self_imitation.batch_size self_imitation.max_age self_imitation.tail_steps "
        "self_imitation.memory_gib "
        "weighting_beta max_weight "
        "steps_per_update batch_size ema_decay warmup_segments tail_steps memory_gib "
        "utd warmup_decisions target_update target_entropy backup_entropy "
        "value_max_grad_norm beta1 "
        "beta2 weight_decay",
        REFUSED: "type kl_base_coef temperature noise_std noise_level noise_steps critic_observation *",
    },
    "record.": {FOLLOWED: "flush_interval_s", REFUSED: "repo_id root streams filmed_streams"},
    "eval.": {FOLLOWED: "n_episodes repetitions split temperature batch_size seed"},
}
FLAGS = {
    group + name: rule
    for group, rules in _TABLE.items()
    for rule, names in rules.items()
    for name in names.split()
}
"""Every flag of cronos-train: FOLLOWED or REFUSED by a resumed run. `group.*` stands for the group's others."""

_OWN_FOLDER = ("output_dir", "resume", "policy.pretrained_path")
"""May be others than the checkpoint's: the folder may have moved, and the weights are the checkpoint's."""


def rule_of(flag: str) -> str:
    """Return what a resumed run does with `flag`, named without its dashes.

    Raises:
        KeyError: the table does not have it.
    """
    parts = flag.split(".")
    groups = (".".join(parts[:length]) for length in range(len(parts), 0, -1))
    for name in groups:
        for key in (name, f"{name}.*"):
            if key in FLAGS:
                return FLAGS[key]
    raise KeyError(flag)


def describe_run(config: Any, interaction_steps: int, interventions: int) -> dict[str, Any]:
    """What a checkpoint keeps to tell its run from another one, JSON-ready; see RUN."""
    return {
        "interaction_steps": interaction_steps,
        "interventions": interventions,
        "config": config.to_dict(),
    } | describe_environment(config.env)


def describe_environment(env: Any) -> dict[str, Any]:
    """The environment's id with its version, and the benchmark's source and fingerprint; None of other kinds."""
    if not isinstance(env, CronosEnvConfig):
        return {"environment": None, "benchmark": None}
    benchmark = load_benchmark(env.benchmark, env.scene)
    return {
        "environment": gymnasium_id(env.scene),
        "benchmark": {"source": benchmark.source, "fingerprint": benchmark.fingerprint},
    }


def read_run(checkpoint: Path) -> dict[str, Any]:
    """Read what a checkpoint says of its run.

    Raises:
        NotADirectoryError: it is no checkpoint of a run.
        ValueError: another version of the environment made it, or the file is damaged.
    """
    folder = checkpoint / TRAINING_STATE_DIR
    if not folder.is_dir():
        raise NotADirectoryError(f"{checkpoint} is no checkpoint of a run: it has no {TRAINING_STATE_DIR}.")
    path = folder / RUN
    what = f"the run of {checkpoint}"
    if not path.is_file():
        check_environment_id(None, what, "begin a new run")
    try:
        run = json.loads(path.read_text())
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if run["environment"] is not None:
        check_environment_id(run["environment"], what, "begin a new run")
    return run


def read_starts(path: Path) -> list[dict[str, Any]]:
    """Read the starts of a run from its manifest.

    Raises:
        ValueError: the file is damaged.
    """
    try:
        return json.loads(path.read_text())["starts"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error


def was_never_told_where_to_push(checkpoint: Path) -> bool:
    """Whether a run has its policy's `repo_id` from the policy alone that it began with.

    Earlier versions took it from there, and pushed the run over that policy.

    Args:
        checkpoint: of the run, whose manifest has its commands; without one it is not known.

    Raises:
        ValueError: the manifest is damaged.
    """
    manifest = checkpoint.parent.parent / MANIFEST
    starts = read_starts(manifest) if manifest.is_file() else []
    commands = [start.get("command", []) for start in starts]
    if not commands or any(parser.parse_arg("policy.repo_id", command) for command in commands):
        return False
    path, file = (parser.parse_arg(name, commands[0]) for name in ("policy.path", "config_path"))
    return path is not None and file is None


def import_plugins(checkpoint: Path, arguments: Sequence[str]) -> None:
    """Import the modules that the run of a checkpoint was started with, `--<field>.discover_packages_path`.

    They are no part of its config, which names what they register.

    Args:
        checkpoint: of the run, whose manifest has its commands.
        arguments: of the command that resumes it; a flag that is among them takes the place of the run's.

    Raises:
        PluginLoadError: one of them cannot be imported.
        ValueError: the manifest is damaged.
    """
    manifest = checkpoint.parent.parent / MANIFEST
    if not manifest.is_file():
        return
    own: dict[str, str] = {}
    for start in read_starts(manifest):
        own |= parser.parse_plugin_args(parser.PLUGIN_DISCOVERY_SUFFIX, start.get("command", []))
    given = parser.parse_plugin_args(parser.PLUGIN_DISCOVERY_SUFFIX, arguments)
    for flag, name in own.items():
        if flag in given:
            continue
        allow_single_file(name)
        try:
            parser.load_plugin(name)
        except parser.PluginLoadError as error:
            raise parser.PluginLoadError(
                f"the run in {manifest.parent} was started with --{flag}={name}: {error}. Put it on "
                f"PYTHONPATH, or give another --{flag}."
            ) from error


def allow_single_file(name: str) -> None:
    """Let `discover_packages_path` name a module as well as a package, in which LeRobot looks for more modules."""
    # LeRobot says what cannot be imported.
    with suppress(ImportError):
        module = importlib.import_module(name)
        module.__path__ = getattr(module, "__path__", [])


def check_types(checkpoint: Path, cli_args: list[str]) -> None:
    """Refuse flags that cannot even be read beside the run's: another kind of environment, policy or algorithm.

    Raises:
        ValueError: as it says.
    """
    run = read_run(checkpoint)
    # LeRobot's parser keeps it from `cli_args`.
    if path := parser.get_path_arg("policy"):
        raise ValueError(_refusal("policy.path", path, "its own policy"))
    # Of the config it is what the run began with, wherever that lies now.
    if path := parser.parse_arg("policy.pretrained_path", cli_args):
        raise ValueError(_refusal("policy.pretrained_path", path, "its own policy"))
    for name in ("env", "policy", "algorithm"):
        given, own = parser.get_type_arg(name, cli_args), (run["config"][name] or {}).get("type")
        if given not in (None, own):
            raise ValueError(_refusal(f"{name}.type", given, own))


def check_resumed(config: Any, checkpoint: Path) -> dict[str, Any]:
    """Check that `config` asks of the run nothing but what it can follow; returns what `read_run` does.

    Raises:
        NotADirectoryError: `checkpoint` is no checkpoint of a run.
        ValueError: a refused flag has another value than the run's, or the run is beyond its end; or the
            benchmark or the environment has changed.
    """
    run = read_run(checkpoint)
    given, own = flatten(config.to_dict()), flatten(run["config"])
    for name in sorted(given.keys() | own.keys(), key=lambda name: "features" in name):
        # A config made in Python, as for a run that begins, leaves the features to the environment.
        same = given.get(name) == own.get(name) or ("features" in name and not given.get(name))
        if not same and name not in _OWN_FOLDER and rule_of(name) == REFUSED:
            raise ValueError(_refusal(name, given.get(name), own.get(name)))
    # The packaged benchmark's source names the release that it came with, its fingerprint what it is.
    now, was = describe_environment(config.env)["benchmark"], run["benchmark"]
    if (now and now["fingerprint"]) != (was and was["fingerprint"]):
        raise ValueError(f"the run of {checkpoint} began with the benchmark {was}, which now is {now}.")
    done, spent, budget = run["interaction_steps"], run["interventions"], config.protocol.reset_budget
    if config.total_steps < done:
        raise ValueError(f"--steps={config.steps}, but the run has done {done} steps: give {done} or more.")
    if budget is not None and budget < spent and budget != own["protocol.reset_budget"]:
        raise ValueError(
            f"--protocol.reset_budget={budget}, but the run has spent {spent}: give more than {spent}, or null."
        )
    return run


def flatten(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested dicts by their flags' names, as JSON has them."""
    flat: dict[str, Any] = {}
    for name, value in json.loads(json.dumps(tree)).items():
        if isinstance(value, dict):
            flat |= flatten(value, f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _refusal(flag: str, given: Any, own: Any) -> str:
    given, own = (value if isinstance(value, str) else json.dumps(value) for value in (given, own))
    return (
        f"--{flag}={given}, but the run that is resumed has {own} and keeps it: leave the flag out, or begin a "
        "new run, with this one's checkpoint as --policy.path."
    )
