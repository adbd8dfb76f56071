"""What a checkpoint of PPO needs besides what its parts keep of themselves."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch.optim import Optimizer

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.state import map_leaves
from cronos_lerobot.processes import Processes


def join_rollouts(rollout: dict[str, Any], processes: Processes) -> dict[str, Any]:
    """The rollouts of all processes as one, in the first of them; they number instructions each in its own way.

    Args:
        rollout: of `RolloutBuffer.state_dict`, as long in every process.
        processes: all call it.
    """
    if not rollout:
        return {}
    texts = sorted(set().union(*processes.gather(rollout["instructions"])))
    numbers = np.array([texts.index(text) for text in rollout["instructions"]])
    rollout = rollout | {"instruction_ids": numbers[rollout["instruction_ids"]]}
    return map_leaves(rollout, np.ndarray, processes.collect) | {"instructions": texts}


def set_optimizer(
    optimizer: Optimizer, config: PPOConfig, saved: dict[str, float], settings: list[dict[str, Any]]
) -> None:
    """Give a loaded optimizer what `config` changes; other learning rates stay as they have become.

    An adaptive one that is beyond the ends that `config` has now goes on from the nearer one.

    Args:
        optimizer: with groups named `policy` and `value`.
        config: to go on with.
        saved: `policy_lr` and `value_lr` of the config that it was saved with.
        settings: what each group has of the config or of the policy, besides its learning rate.

    Raises:
        ValueError: a learning rate that it is given is beyond the ends.
    """
    if config.policy_lr != saved["policy_lr"]:
        config.check_start()
    for group, setting in zip(optimizer.param_groups, settings, strict=True):
        name = f"{group['name']}_lr"
        if getattr(config, name) != saved[name]:
            group["lr"] = getattr(config, name)
        if group["name"] == "policy" and config.lr_schedule != "fixed":
            group["lr"] = min(max(group["lr"], config.policy_lr_min), config.policy_lr_max)
        group |= setting
