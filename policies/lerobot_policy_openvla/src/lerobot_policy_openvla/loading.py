"""Which of the formats a saved policy is in, and what has to be read of it."""

from __future__ import annotations

import json
from copy import copy
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from safetensors import safe_open
from safetensors.torch import load_model
from torch import nn

from lerobot_policy_openvla.adapters import ADAPTER_CONFIG, ADAPTER_WEIGHTS
from lerobot_policy_openvla.checkpoint import (
    CONFIG,
    NETWORK_PREFIX,
    WEIGHTS,
    commit_of,
    fetch,
    holds_network,
    seen_from,
)
from lerobot_policy_openvla.configuration_openvla import OpenVLAConfig


def config_for(
    name: str, revision: str | None, config: PreTrainedConfig | None
) -> tuple[OpenVLAConfig, Path | None]:
    """Return the config to build the policy `name` with, and the model.safetensors to read after that, if any.

    The formats: a published checkpoint; a whole policy; the adapters and the value head of a policy; what
    `lerobot-train --peft...` leaves.

    Args:
        name: folder or Hub repository.
        revision: of the repository.
        config: of the caller, None takes the saved one.

    Raises:
        TypeError: the saved config is of another policy.
    """
    folder = fetch(name, revision)
    revision = commit_of(name, folder) or revision
    published = "type" not in json.loads((folder / CONFIG).read_text()) if (folder / CONFIG).is_file() else False
    if config is None:
        config = OpenVLAConfig() if published else PreTrainedConfig.from_pretrained(folder)
    if not isinstance(config, OpenVLAConfig):
        raise TypeError(f"{name} is a policy of type {config.type!r}, not 'openvla'.")
    if published:
        config.checkpoint, config.checkpoint_revision = name, revision
        return config, None
    if (folder / WEIGHTS).is_file():
        if holds_network(folder):
            # The caller's stays as it is: a run that is resumed compares it with what it began with.
            config = copy(config)
            config.checkpoint, config.checkpoint_revision = name, revision
            return config, folder / WEIGHTS
        return _with_folders(config, folder), folder / WEIGHTS
    if (folder / ADAPTER_WEIGHTS).is_file():
        below: dict[str, Any] = json.loads((folder / ADAPTER_CONFIG).read_text())
        config.checkpoint = config.checkpoint or below["base_model_name_or_path"]
        config.checkpoint = seen_from(folder, config.checkpoint)
        config.adapter, config.use_peft = str(folder), False
        return config, None
    raise FileNotFoundError(f"{name} has neither {WEIGHTS} nor {ADAPTER_WEIGHTS}.")


def _with_folders(config: OpenVLAConfig, folder: Path) -> OpenVLAConfig:
    """The config with what the policy in `folder` is built on as it is called from here; the caller's stays."""
    named = {field: name for field in ("checkpoint", "adapter") if (name := getattr(config, field))}
    found = {field: seen_from(folder, name) for field, name in named.items()}
    if found == named:
        return config
    config = copy(config)
    for field, name in found.items():
        setattr(config, field, name)
    return config


def load_saved_tensors(policy: Any, path: Path) -> None:
    """Read a saved policy's tensors; those of a whole network are in place already, by its checkpoint.

    Raises:
        RuntimeError: names differ from the policy's.
    """
    if not holds_network(path.parent):
        load_model(policy, str(path), device=str(policy.device))
        return
    head: nn.Module = policy.value_head
    prefix = "value_head."
    with safe_open(path, framework="pt", device=str(policy.device)) as file:
        names = [key for key in file.keys() if not key.startswith(NETWORK_PREFIX)]  # noqa: SIM118
        head.load_state_dict({name.removeprefix(prefix): file.get_tensor(name) for name in names})
