"""Between the environment and the policy: LeRobot's processors around raw observations and actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from cronos_lerobot.agents.base import Batch, Columns, TrainablePolicy

VECTOR_KEYS = {"agent_pos": OBS_STATE, "environment_state": OBS_ENV_STATE}
"""Vector observations by LeRobot's names."""


def observation_columns(observation: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """A raw batched observation by LeRobot's names.

    Args:
        observation: the environment's observation dict, every array with leading dimension n.

    Returns:
        `observation.images.<camera>` uint8 (n, H, W, 3), `observation.state` and
        `observation.environment_state` float32 (n, D): those of them that are there. Not copied.
    """
    columns = {f"{OBS_IMAGES}.{camera}": pixels for camera, pixels in observation.get("pixels", {}).items()}
    columns |= {name: observation[key] for key, name in VECTOR_KEYS.items() if key in observation}
    return columns


class PolicyProcessors:
    """The policy's LeRobot pre- and postprocessor, applied to columns of raw observations.

    Args:
        preprocessor: a LeRobot batch -> what the policy takes (normalised, on its device).
        postprocessor: a normalised action (B, A) -> physical units.
        device: the policy's.
        uint8_images: leave images in 0..255 for the policy to scale; only where its preprocessor does not
            normalise images. A third of the inference time of a small network on a CPU.
        encoder: the policy's `encode_observation`, if it has one.
    """

    def __init__(
        self,
        preprocessor: Callable[[Batch], Batch],
        postprocessor: Callable[[Any], Any],
        device: str | torch.device = "cpu",
        *,
        uint8_images: bool = False,
        encoder: Callable[[Batch], Batch] | None = None,
    ) -> None:
        self.preprocessor = preprocessor
        self.postprocessor = postprocessor
        self.device = torch.device(device)
        self.uint8_images = uint8_images
        self._encoder = encoder

    def batch(self, columns: Columns, instructions: list[str]) -> Batch:
        """Return the policy's batch: images (B, 3, H, W), states normalised, `task` strings."""
        batch: Batch = {"task": list(instructions)}
        for name, column in columns.items():
            tensor = torch.from_numpy(np.ascontiguousarray(column)).to(self.device)
            if name.startswith(OBS_IMAGES):
                batch[name] = self._images(tensor.permute(0, 3, 1, 2))
            else:
                batch[name] = tensor.float()
        return self.preprocessor(batch)

    def encode(self, columns: Columns, instructions: list[str]) -> Columns:
        """Return the columns that a rollout keeps: the policy's encodings, or the raw observations."""
        if self._encoder is None:
            return columns
        encoded = self._encoder(self.batch(columns, instructions))
        return {name: value.cpu().numpy() for name, value in encoded.items() if isinstance(value, torch.Tensor)}

    def encoded_batch(self, columns: Columns, instructions: list[str]) -> Batch:
        """Return the policy's batch of columns that `encode` returned."""
        if self._encoder is None:
            return self.batch(columns, instructions)
        tensors = {name: torch.from_numpy(column).to(self.device) for name, column in columns.items()}
        return {"task": list(instructions)} | tensors

    def physical_actions(self, action: torch.Tensor) -> np.ndarray:
        """Return normalised actions (B, A) in the environment's units, float32."""
        return self.postprocessor(action).to("cpu", torch.float32).numpy()

    def _images(self, images: torch.Tensor) -> torch.Tensor:
        # The same conversion as lerobot.envs.preprocess_observation, but on the policy's device.
        return images if self.uint8_images else images.float().div_(255)


def make_processors(policy: Any, preprocessor: Any, postprocessor: Any) -> PolicyProcessors:
    """Return the processors of a LeRobot policy that is on its device."""
    device = next(policy.parameters()).device
    mode = getattr(policy.config, "normalization_mapping", {}).get(FeatureType.VISUAL.value)
    # Other LeRobot policies that do not normalise images scale them themselves, from [0, 1].
    is_untouched = mode == NormalizationMode.IDENTITY and isinstance(policy, TrainablePolicy)
    encoder = getattr(policy, "encode_observation", None)
    return PolicyProcessors(preprocessor, postprocessor, device, uint8_images=is_untouched, encoder=encoder)
