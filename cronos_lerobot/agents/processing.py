"""Between the environment and the policy: LeRobot's processors around raw observations and actions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode
from lerobot.processor import RelativeActionsProcessorStep, TokenizerProcessorStep
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_LANGUAGE, OBS_STATE, OBS_STR

from cronos_lerobot.agents.base import Batch, Columns

EMPTY_CAMERA = f"{OBS_IMAGES}.empty_camera_"
"""How the names of pictures begin that a policy with `--policy.empty_cameras` fills in by itself."""
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
        uint8_images: leave images in 0..255 for the policy to scale; else they are floats in [0, 1]. A third of
            the inference time of a small network on a CPU.
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
        """Return the policy's batch: images (B, 3, H, W), states normalised, `task` strings.

        Columns with a history, (B, n_obs, ...), become observations (B, n_obs, ...), each preprocessed by itself.
        """
        if length := _history_length(columns):
            flat = {name: column.reshape(-1, *column.shape[2:]) for name, column in columns.items()}
            batch = self.batch(flat, [text for text in instructions for _ in range(length)])
            return {name: _unfold(name, value, length) for name, value in batch.items()}
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
        return _to_columns(self._encoder(self.batch(columns, instructions)))

    def encoded_batch(self, columns: Columns, instructions: list[str]) -> Batch:
        """Return the policy's batch of columns that `encode` returned."""
        if self._encoder is None:
            return self.batch(columns, instructions)
        return self.made_batch(columns, instructions)

    def making(self, function: Callable[[Batch], Batch]) -> Callable[[Columns, list[str]], Columns]:
        """Return `function` of the policy's batches as one of columns that `encode` returned, to columns."""

        @torch.no_grad()
        def make(columns: Columns, instructions: list[str]) -> Columns:
            return _to_columns(function(self.encoded_batch(columns, instructions)))

        return make

    def made_batch(self, columns: Columns, instructions: list[str]) -> Batch:
        """Return the batch of columns that the policy itself made: `encode`'s, or those of `making`."""
        tensors = {name: torch.from_numpy(column).to(self.device) for name, column in columns.items()}
        return {"task": list(instructions)} | tensors

    def physical_actions(self, action: torch.Tensor) -> np.ndarray:
        """Return normalised actions (B, A) in the environment's units, float32."""
        return self.postprocessor(action).to("cpu", torch.float32).numpy()

    def _images(self, images: torch.Tensor) -> torch.Tensor:
        # The same conversion as lerobot.envs.preprocess_observation, but on the policy's device.
        return images if self.uint8_images else images.float().div_(255)


class OncePerText:
    """A tokenizer that reads each different text of a batch once: of thousands few are different.

    Args:
        tokenizer: texts and options -> tensors by name, a row for each text, as Hugging Face's do.
    """

    def __init__(self, tokenizer: Any) -> None:
        self.tokenizer = tokenizer

    def __call__(self, texts: list[str], **options: Any) -> dict[str, torch.Tensor]:
        """Tokenize B texts: tensors (B, ...)."""
        index: dict[str, int] = {}
        rows = torch.tensor([index.setdefault(text, len(index)) for text in texts])
        return {name: value[rows] for name, value in self.tokenizer(list(index), **options).items()}


def make_processors(policy: Any, preprocessor: Any, postprocessor: Any) -> PolicyProcessors:
    """Return the processors of a LeRobot policy that is on its device.

    Raises:
        ValueError: its actions are relative to the state that a chunk was planned on.
    """
    _check_absolute(policy, preprocessor)
    for step in getattr(preprocessor, "steps", ()):
        if isinstance(step, TokenizerProcessorStep) and not isinstance(step.input_tokenizer, OncePerText):
            step.input_tokenizer = OncePerText(step.input_tokenizer)
    device = next(policy.parameters()).device
    mode = getattr(policy.config, "normalization_mapping", {}).get(FeatureType.VISUAL.value)
    # A preprocessor that normalises images does so from [0, 1].
    uint8_images = getattr(policy, "takes_uint8_images", False) and mode == NormalizationMode.IDENTITY
    encoder = getattr(policy, "encode_observation", None)
    return PolicyProcessors(preprocessor, postprocessor, device, uint8_images=uint8_images, encoder=encoder)


def _check_absolute(policy: Any, preprocessor: Any) -> None:
    """LeRobot adds the newest state to relative actions, also to those of a chunk that was planned before it."""
    steps = getattr(preprocessor, "steps", ())
    is_enabled = any(isinstance(step, RelativeActionsProcessorStep) and step.enabled for step in steps)
    if is_enabled or getattr(policy.config, "use_relative_actions", False):
        raise ValueError(
            f"--policy.type={policy.config.type} with --policy.use_relative_actions=true plays a chunk of actions "
            "that are each added to the newest state, not to the one that the chunk was planned on: clone the "
            "policy with --policy.use_relative_actions=false."
        )


def _to_columns(batch: Batch) -> Columns:
    return {name: value.cpu().numpy() for name, value in batch.items() if isinstance(value, torch.Tensor)}


def _history_length(columns: Columns) -> int:
    """Observations in each row, or 0 if a row is one observation."""
    for name, column in columns.items():
        if column.ndim == (5 if name.startswith(OBS_IMAGES) else 3):
            return column.shape[1]
    return 0


def _unfold(name: str, value: Any, length: int) -> Any:
    """Rows (B * length, ...) as (B, length, ...); of an instruction's, which are all the same, one each."""
    if name.startswith(f"{OBS_STR}.") and not name.startswith(OBS_LANGUAGE):
        return value.unflatten(0, (-1, length))
    return value[::length] if isinstance(value, torch.Tensor | list) else value
