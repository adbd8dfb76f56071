"""Between the environment and the policy: LeRobot's processors around raw observations and actions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES

from cronos_lerobot.rl.policy import Batch
from cronos_lerobot.rl.rollout_buffer import Columns


class PolicyProcessors:
    """The policy's LeRobot pre- and postprocessor, applied to columns of raw observations.

    Args:
        preprocessor: a LeRobot batch -> what the policy takes (normalised, on its device).
        postprocessor: a normalised action (B, A) -> physical units.
        device: where images are converted to floats.
    """

    def __init__(
        self, preprocessor: Callable[[Batch], Batch], postprocessor: Callable[[Any], Any], device: str | None
    ) -> None:
        self.preprocessor = preprocessor
        self.postprocessor = postprocessor
        self.device = torch.device(device or "cpu")

    def batch(self, columns: Columns, instructions: list[str]) -> Batch:
        """Return the policy's batch: images float (B, 3, H, W) in [0, 1], states normalised, `task` strings."""
        batch: Batch = {"task": list(instructions)}
        for name, column in columns.items():
            tensor = torch.from_numpy(np.ascontiguousarray(column)).to(self.device)
            # The same conversion as lerobot.envs.preprocess_observation, but after the move to the device.
            is_image = name.startswith(OBS_IMAGES)
            batch[name] = tensor.permute(0, 3, 1, 2).float().div_(255) if is_image else tensor.float()
        return self.preprocessor(batch)

    def physical_actions(self, action: torch.Tensor) -> np.ndarray:
        """Return normalised actions (B, A) in the environment's units, float32."""
        return self.postprocessor(action).to("cpu", torch.float32).numpy()
