"""A policy and its processors from their checkpoint, by LeRobot's functions.

LeRobot calls whatever class the processors name, and looks for the policy below adapters in the working directory.
"""

from __future__ import annotations

import importlib
import json
import logging
import sys
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from huggingface_hub import hf_hub_download
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.policies import make_policy
from lerobot.processor import ProcessorStep
from lerobot.utils.constants import POLICY_POSTPROCESSOR_DEFAULT_NAME, POLICY_PREPROCESSOR_DEFAULT_NAME
from safetensors import SafetensorError

from cronos_lerobot.evaluation.policy_source import find_base


def load_policy(config: PreTrainedConfig, env: EnvConfig, rename_map: dict[str, str] | None = None) -> Any:
    """Return the policy of a config on its device, from scratch if the config has no `pretrained_path`.

    PEFT's adapters may name the policy below them as seen from where they were trained (see `find_base`).

    Args:
        config: the policy's; LeRobot fills its features in.
        env: the environment that it acts in.
        rename_map: observations to rename for the policy.

    Raises:
        ValueError, OSError: adapters name a policy that is neither a folder nor on the Hub.
    """
    adapters = config.pretrained_path
    base = find_base(adapters)[1] if config.use_peft and adapters else None
    if base is None:
        return make_policy(config, env_cfg=env, rename_map=rename_map)
    from peft import PeftConfig, PeftModel

    logging.info(f"The adapters in {adapters} go onto the policy in {base}.")
    settings = PeftConfig.from_pretrained(str(adapters))
    # Adapters that are saved elsewhere must find it, too.
    settings.base_model_name_or_path = str(base)
    config.pretrained_path, config.use_peft = base, False
    try:
        policy: Any = make_policy(config, env_cfg=env, rename_map=rename_map)
    finally:
        config.pretrained_path, config.use_peft = adapters, True
    return PeftModel.from_pretrained(policy, str(adapters), config=settings, is_trainable=True)


@contextmanager
def damage_named(path: Path | str | None) -> Generator[None]:
    """Around the loading of a policy: a ValueError names the file of it that is damaged."""
    try:
        yield
    except SafetensorError as error:
        raise ValueError(f"{path}/{SAFETENSORS_SINGLE_FILE} or a processor's file is damaged: {error}") from error
    except json.JSONDecodeError as error:
        raise ValueError(f"a configuration of a processor in {path} is damaged: {error}") from error


REWARD_STEPS = ("reward_classifier_processor", "robometer_encoder", "topreward_encoder")
"""Steps of LeRobot that load a reward model with the code that comes with it. No policy needs one."""


def check_processor_classes(path: str | Path, revision: str | None = None) -> None:
    """Check that a checkpoint's processors name steps of LeRobot, or of modules that are imported already.

    Args:
        path: the checkpoint, a folder or a repository of the Hub.
        revision: of the repository.

    Raises:
        ValueError: a class is none; `--<field>.discover_packages_path` imports your own.
        OSError: the Hub has no such file.
    """
    for name in (POLICY_PREPROCESSOR_DEFAULT_NAME, POLICY_POSTPROCESSOR_DEFAULT_NAME):
        file = Path(path) / f"{name}.json"
        if not Path(path).is_dir():
            file = Path(hf_hub_download(str(path), file.name, revision=revision))
        if not file.is_file():
            continue
        for step in json.loads(file.read_text())["steps"]:
            if (known := step.get("registry_name")) in REWARD_STEPS:
                raise ValueError(
                    f"{file} has the step {known}, which runs the code of a reward model: it is not run."
                )
            if (named := step.get("class")) and not _is_step(str(named)):
                raise ValueError(
                    f"{file} names {named}, which is no step of LeRobot or of an imported module: it is not run. "
                    "--policy.discover_packages_path=<package> imports your own steps."
                )


def _is_step(path: str) -> bool:
    module, _, name = path.rpartition(".")
    if module.partition(".")[0] == "lerobot":
        with suppress(ImportError):
            importlib.import_module(module)
    found: Any = getattr(sys.modules.get(module), name, None)
    return isinstance(found, type) and issubclass(found, ProcessorStep)
