"""Makes the parts of a run that its config names: environments, policy, processors."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.policies import make_pre_post_processors
from lerobot.utils.random_utils import deserialize_rng_state, serialize_rng_state, set_seed
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.simulation.simulation import num_cores

from cronos_lerobot.agents.base import samples
from cronos_lerobot.agents.imitation.config import DemosConfig
from cronos_lerobot.agents.processing import make_processors, observation_columns
from cronos_lerobot.agents.steering.steered import STEERING
from cronos_lerobot.agents.weights import train_in_float32, wrap
from cronos_lerobot.evaluation.policy_env import (
    check_observations,
    environment_of_dataset,
    trained_scene,
    warn_of_inputs,
)
from cronos_lerobot.evaluation.policy_loading import check_processor_classes, damage_named, load_policy
from cronos_lerobot.evaluation.policy_source import UNDECISIVE, load_policy_config
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.streams import Streams, create_eval_streams
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.training.config import CronosTrainConfig, check_world
from cronos_lerobot.training.run import Parts

RENAME_STEP, DEVICE_STEP = "rename_observations_processor", "device_processor"
"""LeRobot's names of steps of a preprocessor."""


def make_parts(config: CronosTrainConfig, ranks: Ranks) -> Parts:
    """Return the environments, the policy on its device and its processors.

    Raises:
        ValueError: the policy was made for other observations or actions, or its files are damaged; or
            demonstrations are of another scene.
    """
    share = ranks.share_of(config.num_envs)
    num_envs = share.stop - share.start
    set_seed(config.seed)
    policy, preprocessor, postprocessor = make_policy_and_processors(config)
    if not ranks.is_main:
        set_seed(ranks.own_seed(config.seed))
    env = make_env(config, num_envs, ranks.local_count)
    check_world(config, env)
    if config.checkpoint_path is None:
        check_demonstrations(config.algorithm, env.identity.id)
    if config.algorithm.type == "imitation" and not samples(policy):
        check_decision(policy, preprocessor, postprocessor, env)
    own_eval_env = partial(make_eval_env, config, local_processes=ranks.local_count)
    return Parts(env, own_eval_env, policy, preprocessor, postprocessor, ranks)


def make_env(config: CronosTrainConfig, num_envs: int, local_processes: int = 1) -> Streams:
    """Return `num_envs` streams of the config's world; they never reset themselves.

    `local_processes` of this node share its cores, unless the config says how many threads each takes.

    Raises:
        ValueError: `--protocol.reward` is given, and the world has its own.
    """
    reward, env = config.protocol.reward, _of_one_process(config, local_processes)
    if reward == ProtocolConfig().reward:
        return env.create_streams(num_envs)
    try:
        return env.create_streams(num_envs, reward=reward)
    except TypeError as error:
        raise ValueError(f"--protocol.reward={reward}: --env.type={env.type} has a reward of its own") from error


def make_eval_env(config: CronosTrainConfig, num_envs: int, local_processes: int = 1) -> Streams:
    """Return `num_envs` streams of the config's world for the periodic evaluation; see `make_env`."""
    return create_eval_streams(_of_one_process(config, local_processes), num_envs)


def _of_one_process(config: CronosTrainConfig, local_processes: int) -> Any:
    """The environment's config with its share of the node's cores, if it has `num_threads`."""
    env: Any = config.env
    if local_processes > 1 and getattr(env, "num_threads", None) == 0:
        return replace(env, num_threads=max(1, num_cores() // local_processes))
    return env


def make_policy_and_processors(config: CronosTrainConfig) -> tuple[Any, Any, Any]:
    """Return the config's policy on its device, its preprocessor and its postprocessor; see `make_parts`."""
    env_config, path = config.env, config.weights_path
    assert env_config is not None
    policy_config = _config_to_build(config)
    check_observations(policy_config, env_config, config.rename_map)
    check_pictures(policy_config, env_config, config.rename_map)
    if config.checkpoint_path is None:
        _warn(policy_config, config)
    # What is saved of a resumed run names the policy that it began with, and no checkpoint.
    base, policy_config.pretrained_path = policy_config.pretrained_path, path
    with damage_named(path):
        loaded = load_policy(policy_config, env_config, config.rename_map)
        policy_config.pretrained_path = base
        assert config.policy is not None
        config.policy.input_features = policy_config.input_features
        config.policy.output_features = policy_config.output_features
        if config.peft is None:
            train_in_float32(loaded, path, policy_config.pretrained_revision)
        return wrap(loaded, config.peft), *_make_processors(policy_config, path, config.rename_map)


def _make_processors(policy: PreTrainedConfig, path: Path | None, rename_map: dict[str, str]) -> tuple[Any, Any]:
    """Those of the checkpoint that the run begins with, on the policy's device; new ones from scratch."""
    if path is None:
        return make_pre_post_processors(policy)
    overrides: dict[str, Any] = {DEVICE_STEP: {"device": policy.device}}
    if rename_map:
        overrides[RENAME_STEP] = {"rename_map": rename_map}
    # The revision is of the policy that the run begins with, not of where this one will be pushed to.
    revision, policy.pretrained_revision = policy.pretrained_revision, None
    check_processor_classes(path, revision)
    return make_pre_post_processors(
        policy, str(path), pretrained_revision=revision, preprocessor_overrides=overrides
    )


def _config_to_build(config: CronosTrainConfig) -> PreTrainedConfig:
    """The config to build the policy from, which resolves it: the run's own stays as it was given.

    A resumed run has it, resolved, beside its weights.
    """
    given = config.policy
    assert given is not None
    if config.checkpoint_path is None:
        return deepcopy(given)
    assert config.weights_path is not None
    saved = load_policy_config(config.weights_path, [])
    for name in ("device", *UNDECISIVE):
        setattr(saved, name, getattr(given, name))
    return saved


def check_decision(policy: Any, preprocessor: Any, postprocessor: Any, env: Streams) -> None:
    """Ask a policy that acts by LeRobot's `select_action` for one decision, which leaves no trace.

    Raises:
        ValueError: it has none that works, so that nobody could play what is trained.
    """
    random_numbers, was_training = serialize_rng_state(), policy.training
    processors = make_processors(policy, preprocessor, postprocessor)
    try:
        policy.eval().reset()
        batch = processors.batch(observation_columns(env.observe()), [""] * env.num_envs)
        with torch.no_grad():
            processors.physical_actions(policy.select_action(batch))
        policy.reset()
    except Exception as error:
        raise ValueError(
            f"--policy.type={policy.config.type} cannot act: its select_action, by which "
            f"--algorithm.type=imitation plays policies, ends in {type(error).__name__}: {error}"
        ) from error
    policy.train(was_training)
    deserialize_rng_state(random_numbers)


def _warn(policy: PreTrainedConfig, config: CronosTrainConfig) -> None:
    """Say what a new run may not mean to begin with."""
    env, path = config.env, config.weights_path
    warn_of_inputs(policy, env)
    if path is None or not isinstance(env, CronosEnvConfig):
        return
    if (Path(path) / STEERING).is_file():
        logging.warning(f"The run begins without the actor ({STEERING}) in {path}, which steers the policy there.")
    if (trained := trained_scene(Path(path)).get("scene", env.scene)) != env.scene:
        # Its sizes may be the same.
        logging.warning(f"{path} was trained in --env.scene={trained}: it does not know {env.scene}.")


def check_demonstrations(algorithm: Any, environment: str) -> None:
    """Check that an agent's demonstrations, if they are on this machine, are of the run's scene.

    They may be of its simulation where the run is on a robot.

    Raises:
        ValueError: they are of another one, whose columns may have the same sizes.
    """
    demos = getattr(algorithm, "demos", None)
    if not isinstance(demos, DemosConfig) or demos.repo_id is None:
        return
    other = environment_of_dataset(demos.repo_id, demos.root)
    if other and other.split("/")[-1] != environment.split("/")[-1]:
        raise ValueError(f"--algorithm.demos.repo_id={demos.repo_id} is of {other}, not of {environment}.")


def check_pictures(policy: PreTrainedConfig, env: EnvConfig, rename_map: Mapping[str, str] | None = None) -> None:
    """Warn of pictures of another size than the policy was made for: not every policy scales them.

    Raises:
        ValueError: the policy says that it does not.
    """
    names = {key: (rename_map or {}).get(name, name) for key, name in env.features_map.items()}
    shown = {names[key]: feature.shape for key, feature in env.features.items()}
    for name, feature in (policy.input_features or {}).items():
        size = tuple(shown.get(name, ()))[:2]
        if feature.type is not FeatureType.VISUAL or not size or tuple(feature.shape[1:]) == size:
            continue
        height, width = feature.shape[1:]
        text = f"--env.observation_height={height} --env.observation_width={width} is what the policy was made for"
        if name in getattr(policy, "unscaled_images", ()):
            raise ValueError(f"{text}, and it scales no pictures: give that.")
        logging.warning(
            f"{text}; it learns from {size[0]} x {size[1]} here, and not every policy scales pictures."
        )
