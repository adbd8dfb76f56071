"""Makes the environments and the policy that a training config names."""

from __future__ import annotations

import logging
from collections.abc import Generator
from contextlib import contextmanager, suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

from httpx import HTTPError
from huggingface_hub import file_exists, hf_hub_download
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import ACTION
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv, SequentialVectorEnv, get_scene
from lerobot_env_cronos.hub_config import is_of_this_package
from lerobot_env_cronos.simulation.simulation import num_cores

from cronos_lerobot.agents.imitation.config import DemosConfig
from cronos_lerobot.agents.processing import EMPTY_CAMERA
from cronos_lerobot.agents.steering.steered import STEERING
from cronos_lerobot.agents.weights import is_wrapped, train_in_float32, wrap
from cronos_lerobot.evaluation.policy_env import (
    check_task_observation,
    scene_of_dataset,
    trained_scene,
    warn_of_privileged_state,
)
from cronos_lerobot.evaluation.policy_loading import load_policy
from cronos_lerobot.evaluation.policy_source import UNDECISIVE, damage_named, load_policy_config
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.configurations import check_configurations


def make_env(config: CronosTrainConfig, num_envs: int, local_processes: int = 1) -> CronosVectorEnv:
    """Return `num_envs` streams of the config's scene; they never reset themselves.

    `local_processes` of this node share its cores, unless the config says how many threads each takes.

    Raises:
        ValueError: the environment is not a CRONOS scene, or has fewer configurations than are asked for.
    """
    env_config = _cronos(config)
    options = _env_options(env_config, local_processes)
    env = CronosVectorEnv(num_envs, scene=env_config.scene, reward=config.protocol.reward, **options)
    try:
        check_configurations(config, env.benchmark, str(env_config.benchmark or env_config.scene))
    except ValueError:
        env.close()
        raise
    return env


def make_eval_env(config: CronosTrainConfig, num_envs: int, local_processes: int = 1) -> SequentialVectorEnv:
    """Return `num_envs` environments of the config's scene for the periodic evaluation; see `make_env`."""
    env_config = _cronos(config)
    tasks = get_scene(env_config.scene).tasks
    return SequentialVectorEnv(
        num_envs, env_config.scene, ordering=tasks, **_env_options(env_config, local_processes)
    )


def _cronos(config: CronosTrainConfig) -> CronosEnvConfig:
    if not is_of_this_package(config.env):
        name = config.env.type if config.env else None
        raise ValueError(f"Reset-free training needs --env.type=cronos, got {name!r}.")
    return config.env


def _env_options(env_config: CronosEnvConfig, local_processes: int) -> dict[str, Any]:
    options = env_config.gym_kwargs
    if options["num_threads"] == 0 and local_processes > 1:
        options["num_threads"] = max(1, num_cores() // local_processes)
    return options


def make_policy_and_processors(config: CronosTrainConfig) -> tuple[Any, Any, Any]:
    """Return the config's policy on its device, its preprocessor and its postprocessor.

    Raises:
        ValueError: the policy was made for other observations or actions, or its files are damaged; or
            demonstrations are of another scene.
    """
    env_config, path = _cronos(config), config.weights_path
    policy_config = _config_to_build(config)
    check_task_observation(policy_config, env_config)
    check_features(policy_config, env_config)
    if policy_config.use_amp:
        raise ValueError(
            "--policy.use_amp=true is followed by evaluations alone: cronos-train acts and learns in the policy's "
            "own precision. Give --policy.use_amp=false."
        )
    if not config.resume:
        check_demonstrations(config.algorithm, env_config.scene)
    if not (path or getattr(policy_config, "checkpoint", None)):
        logging.warning("Training a policy from scratch: its states are not normalised, its success starts at 0.")
    with damage_named(path):
        with _pretrained(policy_config, path):
            loaded = load_policy(policy_config, env_config)
        assert config.policy is not None
        config.policy.input_features = policy_config.input_features
        config.policy.output_features = policy_config.output_features
        if config.peft is not None and not config.resume:
            check_adapters(loaded, policy_config)
        if config.peft is None:
            train_in_float32(loaded, path, policy_config.pretrained_revision)
        policy = wrap(loaded, config.peft)
        if path is None:
            return policy, *make_pre_post_processors(policy_config)
        if not config.resume:
            warn_of_actor(policy_config, config.algorithm.type)
            warn_of_privileged_state(policy_config)
            warn_of_other_scene(policy_config, env_config.scene)
        # Like lerobot-train: the checkpoint's processors, on the device of this run.
        device = {"device_processor": {"device": policy_config.device}}
        # It is of the policy that the run begins with, and no revision of where this one will be pushed to.
        revision, policy_config.pretrained_revision = policy_config.pretrained_revision, None
        return policy, *make_pre_post_processors(
            policy_config, str(path), pretrained_revision=revision, preprocessor_overrides=device
        )


def _config_to_build(config: CronosTrainConfig) -> PreTrainedConfig:
    """The config to build the policy from, which resolves it: the run's own stays as it was given.

    A resumed run has it, resolved, beside its weights.
    """
    given = config.policy
    assert given is not None
    if not config.resume:
        return deepcopy(given)
    saved = load_policy_config(str(config.weights_path), [])
    for name in ("device", *UNDECISIVE):
        setattr(saved, name, getattr(given, name))
    return saved


@contextmanager
def _pretrained(policy: PreTrainedConfig, path: Path | str | None) -> Generator[None]:
    """Load from `path`: what is saved of a resumed run names the policy that it began with, and no checkpoint."""
    base, policy.pretrained_path = policy.pretrained_path, path  # ty: ignore[invalid-assignment]
    try:
        yield
    finally:
        policy.pretrained_path = base


def check_adapters(loaded: Any, policy: PreTrainedConfig) -> None:
    """Check that a policy can get the adapters of `--peft.*`, and that they can go where they are to be pushed.

    Raises:
        ValueError: it has some already; or who downloads them would look for its base in a folder here.
    """
    if is_wrapped(loaded):
        raise ValueError(
            f"--policy.path={policy.pretrained_path} has adapters, which go on being trained: leave --peft.* out."
        )
    if policy.push_to_hub and policy.repo_id and Path(str(policy.pretrained_path)).is_dir():
        raise ValueError(
            f"--policy.repo_id={policy.repo_id}: adapters name the policy that they go onto, which is the folder "
            f"{policy.pretrained_path}. Give --policy.push_to_hub=false in its place; `cronos-publish policy "
            "--base_policy=` pushes them with the repository that has it."
        )


def warn_of_actor(policy: PreTrainedConfig, algorithm: str) -> None:
    """Say what becomes of the actor that lies in a steered checkpoint, a folder's or one of the Hub's."""
    path = str(policy.pretrained_path)
    if Path(path).is_dir():
        has_actor = (Path(path) / STEERING).is_file()
    else:
        try:
            has_actor = file_exists(path, STEERING, revision=getattr(policy, "pretrained_revision", None))
        except (OSError, HTTPError):
            return
    if has_actor:
        logging.warning(
            f"{path} has an actor that steers the policy ({STEERING}): --algorithm.type={algorithm} begins with "
            "the frozen policy, without that actor, which stays where it is and is in no checkpoint of this run."
        )


def warn_of_other_scene(policy: PreTrainedConfig, scene: str) -> None:
    """Say so if a checkpoint was trained in another scene: what it reads may have the same sizes.

    Args:
        policy: whose `pretrained_path` is a folder or of the Hub.
        scene: of the run.
    """
    folder, trained = Path(str(policy.pretrained_path)), {}
    # What is damaged, or not there, keeps no run from beginning.
    with suppress(ValueError, OSError, HTTPError):
        if not folder.is_dir():
            revision = getattr(policy, "pretrained_revision", None)
            folder = Path(hf_hub_download(str(folder), TRAIN_CONFIG_NAME, revision=revision)).parent
        trained = trained_scene(folder)
    if trained.get("scene", scene) != scene:
        logging.warning(
            f"{policy.pretrained_path} was trained in --env.scene={trained['scene']}, this run is in --env.scene="
            f"{scene}: the policy does not know its objects."
        )


def check_demonstrations(algorithm: Any, scene: str) -> None:
    """Check that an agent's demonstrations, where they are on this machine and say so, are of the run's scene.

    Raises:
        ValueError: they are of another one, whose columns may have the same sizes.
    """
    demos = getattr(algorithm, "demos", None)
    if not isinstance(demos, DemosConfig) or demos.repo_id is None:
        return
    if (other := scene_of_dataset(demos.repo_id, demos.root)) not in (None, scene):
        raise ValueError(
            f"--algorithm.demos.repo_id={demos.repo_id} is of --env.scene={other}, this run is in "
            f"--env.scene={scene}: record demonstrations there."
        )


def check_features(policy: PreTrainedConfig, env: CronosEnvConfig) -> None:
    """Check that the environment shows what the policy reads and takes the actions that it gives.

    Raises:
        ValueError: it does not; the message names the feature, both sizes, and the flag that may be wrong.
    """
    shown = {env.features_map[name]: feature for name, feature in env.features.items()}
    for name, feature in ((policy.input_features or {}) | (policy.output_features or {})).items():
        if name not in shown:
            if name.startswith(EMPTY_CAMERA):
                # Of --policy.empty_cameras: the policy fills it in by itself.
                continue
            raise ValueError(
                f"the policy reads {name}, which is not shown with --env.obs_type={env.obs_type} and "
                f"--env.camera_name={env.camera_name}; that shows {sorted(shown.keys() - {ACTION})}."
            )
        size, own = feature.shape, shown[name].shape
        # A picture is (channels, height, width) to LeRobot's policies, (height, width, channels) to environments.
        if feature.type is FeatureType.VISUAL and tuple(size[1:]) != (pixels := tuple(own[:2])):
            if name in getattr(policy, "unscaled_images", ()):
                raise ValueError(
                    f"the policy was made for {name} of {size[1]} x {size[2]} pixels, and scales none: give "
                    f"--env.observation_height={size[1]} --env.observation_width={size[2]}."
                )
            logging.warning(
                "The policy was made for %s of %d x %d pixels and learns here from %d x %d: not every policy "
                "scales pictures. --env.observation_height=%d --env.observation_width=%d shows it its own, as "
                "evaluations of its checkpoints will.", name, *size[1:], *pixels, *size[1:],
            )  # fmt: skip
        if feature.type is not FeatureType.VISUAL and tuple(size) != tuple(own):
            raise ValueError(
                f"the policy was made for {name} of {size[0]} numbers, {env.scene} has {own[0]}: it is of another "
                "scene, robot or --env.task_observation."
            )
