"""What actor and critics of steering read."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from cronos_lerobot.agents.adapters.privileged import text_vector
from cronos_lerobot.agents.base import Batch
from cronos_lerobot.agents.history import blank_columns
from cronos_lerobot.agents.processing import PolicyProcessors


def resolve_observation(observation: str, policy: Any) -> str:
    """Return `policy` or `state` for a SteeringConfig's observation.

    Raises:
        ValueError: `state` of a policy that observes no vector.
    """
    vectors = vector_names(policy)
    if observation == "auto":
        return "state" if OBS_ENV_STATE in vectors else "policy"
    if observation == "state" and not vectors:
        raise ValueError(
            f"--algorithm.observation=state needs a policy that observes {OBS_STATE} or {OBS_ENV_STATE}, this one "
            f"observes {sorted(policy.input_features or {})}: give --algorithm.observation=policy."
        )
    return observation


def vector_names(policy: Any) -> list[str]:
    """The vectors that a policy observes, by LeRobot's names."""
    return [name for name in (OBS_STATE, OBS_ENV_STATE) if name in (policy.input_features or {})]


def state_features(steerable: Any, batch: Batch) -> Tensor:
    """The vectors that a policy observes and its instructions, (B, F) float32.

    Args:
        steerable: the policy or its adapter.
        batch: preprocessed.
    """
    vectors = [batch[name].flatten(1).float() for name in vector_names(steerable.config)]
    instruction = getattr(steerable, "instruction", str)
    texts = np.stack([text_vector(instruction(text)) for text in batch["task"]])
    return torch.cat([*vectors, torch.from_numpy(texts).to(vectors[0].device)], 1)


@torch.inference_mode()
def feature_width(observation: str, steerable: Any, processors: PolicyProcessors) -> int:
    """F, the width of what `observation` names, found by showing the policy nothing."""
    batch = processors.batch(blank_columns(steerable), ["put it there"])
    features = state_features(steerable, batch) if observation == "state" else steerable.observe(batch)[1]
    return features.shape[1]
