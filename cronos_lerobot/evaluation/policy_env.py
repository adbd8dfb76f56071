"""The environment that a policy expects: what it observes, and where it was trained."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from huggingface_hub import try_to_load_from_cache
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.configs.train import TRAIN_CONFIG_NAME
from lerobot.datasets import CODEBASE_VERSION
from lerobot.datasets.utils import INFO_PATH
from lerobot.envs import EnvConfig
from lerobot.utils.constants import (
    ACTION,
    HF_LEROBOT_HOME,
    HF_LEROBOT_HUB_CACHE,
    OBS_ENV_STATE,
    OBS_IMAGES,
    OBS_STATE,
)
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.arms.registry import ARMS
from lerobot_env_cronos.scene.scenes import SCENES, get_scene
from lerobot_env_cronos.simulation.observations import TASK_OBSERVATIONS

from cronos_lerobot.agents.processing import EMPTY_CAMERA
from cronos_lerobot.data.origin import Origin, read_origin
from cronos_lerobot.environment_id import is_of_a_scene

WITHOUT_LANGUAGE = ("act", "diffusion", "gaussian_actor", "tdmpc", "vqbet")
"""LeRobot's policies that read no instruction."""

Features = Mapping[str, PolicyFeature]


def reads_privileged_state(config: PreTrainedConfig) -> bool:
    """Whether a policy acts on the bodies' poses beside its pictures, which no robot has.

    LeRobot makes an input of all that a dataset has. A policy whose critic reads the poses, such as PocketVLA, has
    them among its inputs for the critic alone.
    """
    inputs = config.input_features or {}
    has_pictures = any(feature.type is FeatureType.VISUAL for feature in inputs.values())
    return has_pictures and OBS_ENV_STATE in inputs and not hasattr(config, "critic_observation")


def warn_of_inputs(config: PreTrainedConfig, env: Any) -> None:
    """Log if a policy cannot know its task, or reads what no robot has."""
    is_untold = isinstance(env, CronosEnvConfig) and env.task_observation == "none"
    if config.type in WITHOUT_LANGUAGE and is_untold and (num_tasks := len(get_scene(env.scene).tasks)) > 1:
        logging.warning(
            f"--policy.type={config.type} reads no instructions and is not told its task "
            f"(--env.task_observation=one_hot): it cannot tell the {num_tasks} tasks apart."
        )
    if reads_privileged_state(config):
        logging.warning(
            "The policy reads %s beside its pictures, the poses of all bodies. No robot has them: it was cloned "
            "from a dataset that shows them (--env.privileged_state=true).",
            OBS_ENV_STATE,
        )


def trained_scene(path: Path | None) -> dict[str, str]:
    """The scene that a checkpoint was trained in, by `cronos-train` or by LeRobot on a dataset of a scene.

    Empty if it does not say, or if its dataset is not on this machine.

    Raises:
        ValueError: its config is damaged, or its scene is not registered here.
    """
    env, origin = _training(path)
    scene = env.get("scene") or (origin.scene if origin and is_of_a_scene(origin.environment) else None)
    if not scene:
        return {}
    try:
        return {"scene": get_scene(scene).name}
    except ValueError as error:
        raise ValueError(f"the policy in {path} was trained in a scene that is not here: {error}") from error


def trained_observations(features: Features, path: Path | None) -> dict[str, Any]:
    """Fields of `CronosEnvConfig` that show a policy what it takes, as its training or its dataset did.

    Args:
        features: its `input_features`.
        path: its checkpoint, which tells the renderer of the pictures that it learned from.

    Raises:
        ValueError: the checkpoint's config is damaged.
    """
    images = {name: feature for name, feature in features.items() if feature.type is FeatureType.VISUAL}
    takes_state = OBS_ENV_STATE in features
    if not images:
        return {"obs_type": "environment_state_agent_pos"} if takes_state else {}
    derived: dict[str, Any] = {"obs_type": "pixels_agent_pos", "privileged_state": takes_state}
    known = dict.fromkeys(name for arm in ARMS.values() for name in arm.cameras)
    if cameras := [name for name in known if f"{OBS_IMAGES}.{name}" in images]:
        derived["camera_name"] = ",".join(cameras)
    # LeRobot passes images of another size on without a word.
    _, height, width = next(iter(images.values())).shape
    env, origin = _training(path)
    # The environment beside a dataset is that of LeRobot's evaluations alone.
    renderer = (origin and origin.flags.get("env.renderer")) or env.get("renderer")
    sizes = {"observation_height": height, "observation_width": width}
    return derived | sizes | ({"renderer": renderer} if renderer else {})


def _training(path: Path | None) -> tuple[dict[str, Any], Origin | None]:
    """The scene's environment that a checkpoint was trained in, and where its dataset comes from."""
    file = Path(path or "") / TRAIN_CONFIG_NAME
    config = json.loads(file.read_text()) if file.is_file() else {}
    env, dataset = config.get("env") or {}, config.get("dataset") or {}
    origin = None
    if isinstance(repo_id := dataset.get("repo_id"), str):
        origin = _origin_of(repo_id, dataset.get("root"), dataset.get("revision"))
    return env if env.get("type", "cronos") == "cronos" else {}, origin


def environment_of_dataset(repo_id: str, root: Path | str | None, revision: str | None = None) -> str | None:
    """The environment's id of a dataset on this machine; None if there is none that says it.

    Args:
        repo_id: its name, "owner/name".
        root: its folder; None looks where LeRobot keeps its datasets, then among those that it has downloaded.
        revision: of a downloaded one; None is that of LeRobot's format.
    """
    origin = _origin_of(repo_id, root, revision)
    return origin.environment if origin else None


def _origin_of(repo_id: str, root: Path | str | None, revision: str | None) -> Origin | None:
    try:
        folder = Path(root) if root else _find_dataset(repo_id, revision)
        features = json.loads((folder / INFO_PATH).read_text())["features"]
        return read_origin(folder, features, f"dataset {repo_id}")
    except (OSError, ValueError, KeyError):
        # Not here, of another version, or not of these scenes at all.
        return None


def _find_dataset(repo_id: str, revision: str | None) -> Path:
    """The folder in which LeRobot finds a dataset without asking the Hub."""
    folder = HF_LEROBOT_HOME / repo_id
    if (folder / INFO_PATH).is_file():
        return folder
    info = try_to_load_from_cache(
        repo_id, INFO_PATH, HF_LEROBOT_HUB_CACHE, revision or CODEBASE_VERSION, repo_type="dataset"
    )
    return Path(info).parents[1] if isinstance(info, str) else folder


def check_observations(
    policy: PreTrainedConfig, env: EnvConfig, rename_map: Mapping[str, str] | None = None
) -> None:
    """Check that an environment shows a policy what it takes, and takes its actions, of the right sizes.

    Images may have another size: a policy that does not scale them was trained with those that it gets.

    Args:
        policy: its config.
        env: of the environment.
        rename_map: the policy's names of observations, by the environment's.

    Raises:
        ValueError: it does not; names the flag that would.
    """
    if isinstance(env, CronosEnvConfig):
        told = task_observation_of(policy.input_features or {}, env)
        if told != env.task_observation:
            raise ValueError(
                f"the policy takes {OBS_STATE} as with --env.task_observation={told}; the environment has "
                f"--env.task_observation={env.task_observation}"
            )
    names = {key: name for key, name in env.features_map.items() if key in env.features}
    given = {(rename_map or {}).get(name, name): env.features[key] for key, name in names.items()}
    for name, taken in ((policy.input_features or {}) | (policy.output_features or {})).items():
        feature = given.get(name)
        if feature is None:
            if name.startswith(EMPTY_CAMERA):
                continue
            raise ValueError(
                f"the policy takes {name}, which the environment does not give: {_flag_of(name, env)} --rename_map"
                " gives it another name"
            )
        if taken.type is not FeatureType.VISUAL and tuple(taken.shape) != tuple(feature.shape):
            raise ValueError(
                f"the policy was made for {name} of {taken.shape[0]} numbers, the environment has "
                f"{feature.shape[0]}: it was trained {_where_it_fits(name, taken.shape[0], env)}"
            )


def _flag_of(name: str, env: EnvConfig) -> str:
    """What makes a CRONOS scene show an observation."""
    if not isinstance(env, CronosEnvConfig):
        return ""
    if name == OBS_ENV_STATE:
        return "--env.obs_type=environment_state_agent_pos does, or"
    return "--env.obs_type=pixels_agent_pos with --env.camera_name=<its cameras> does, or"


def _where_it_fits(name: str, size: int, env: EnvConfig) -> str:
    if not isinstance(env, CronosEnvConfig):
        return "elsewhere"
    told = env.task_observation
    fitting = [f"--env.scene={scene}" for scene in SCENES if _size(name, scene, env, told) == size]
    if name == ACTION or not fitting:
        return "with other options"
    return f"in another scene; {' or '.join(fitting)} fits"


def task_observation_of(features: Features, env: CronosEnvConfig) -> str:
    """How a policy is told its task in the environment's scene, by the size of the state in its `input_features`.

    As the environment has it, if the policy takes no state, or one of a size that the scene never gives.
    """
    if (state := features.get(OBS_STATE)) is not None:
        for told in (env.task_observation, *TASK_OBSERVATIONS):
            if _size(OBS_STATE, env.scene, env, told) == state.shape[0]:
                return told
    return env.task_observation


def _size(name: str, scene: str, env: CronosEnvConfig, task_observation: str) -> int:
    """Of a vector in another scene."""
    others = {"fps": 0, "camera_name": "front", "benchmark": None, "task": None}
    other = replace(env, scene=scene, task_observation=task_observation, **others)
    return next(other.features[key].shape[0] for key, feature in other.features_map.items() if feature == name)
