"""A policy from its checkpoint: LeRobot's `make_policy`, for adapters from whatever folder it is called."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from httpx import HTTPError
from huggingface_hub.errors import HFValidationError
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy
from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.evaluation.policy_source import find_base


def load_policy(config: PreTrainedConfig, env: CronosEnvConfig, rename_map: dict[str, str] | None = None) -> Any:
    """Return the policy of a config on its device, from scratch if the config has no `pretrained_path`.

    PEFT's adapters may name the policy below them as seen from where they were trained (see `find_base`).

    Args:
        config: the policy's; LeRobot fills its features in.
        env: the environment that it acts in.
        rename_map: observations to rename for the policy.

    Raises:
        ValueError: adapters name a policy that is neither a folder nor on the Hub.
    """
    folder = Path(str(config.pretrained_path or ""))
    name, base = find_base(folder) if config.use_peft and config.pretrained_path else (None, None)
    if base is not None:
        return _with_adapters(config, base, env, rename_map)
    try:
        return make_policy(config, env_cfg=env, rename_map=rename_map)
    except (OSError, HTTPError, HFValidationError) as error:
        if name is None:
            raise
        raise ValueError(
            f"the adapters in {folder} go onto {name}, which is no folder here or in a folder above them, and the "
            f"Hub did not give it: {error}"
        ) from error


def _with_adapters(
    config: PreTrainedConfig, base: Path, env: CronosEnvConfig, rename_map: dict[str, str] | None
) -> Any:
    """What `make_policy` does for adapters, with the policy in `base` below them."""
    from peft import PeftConfig, PeftModel

    logging.info(f"The adapters in {config.pretrained_path} go onto the policy in {base}.")
    adapters = config.pretrained_path
    settings = PeftConfig.from_pretrained(str(adapters))
    # Adapters that are saved elsewhere must find it, too.
    settings.base_model_name_or_path = str(base)
    config.pretrained_path, config.use_peft = base, False
    try:
        policy: Any = make_policy(config, env_cfg=env, rename_map=rename_map)
    finally:
        config.pretrained_path, config.use_peft = adapters, True
    return PeftModel.from_pretrained(policy, str(adapters), config=settings, is_trainable=True)
