"""A frozen policy with an actor that chooses its noise: what acts, is evaluated, and lies in a checkpoint."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from lerobot.utils.hub import HubMixin
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from cronos_lerobot.agents.adapters.privileged import text_vector
from cronos_lerobot.agents.adapters.registry import make_steerable
from cronos_lerobot.agents.base import Batch, Columns, observation_steps
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.agents.steering.sac import NoiseActor, Whitening

STEERING = "steering.safetensors"
"""The actor, beside the policy in `pretrained_model`. LeRobot does not look at it and plays the frozen policy."""
OWN = ("actor.", "whitening.")
"""What is the actor's in a SteeredPolicy; all else is the policy's or its adapter's."""


@dataclass(frozen=True)
class SteeringShape:
    """What an actor looks like."""

    features: int
    """F, numbers that it reads."""
    observation: str
    """What they are: `policy` or `state`, see SteeringConfig."""
    noise_magnitude: float
    noise_repeat: bool
    hidden_width: int


class SteeredPolicy(nn.Module, HubMixin):
    """Plays what the frozen policy makes of the noise that the actor chooses.

    The actor chooses the noise of the action's dimensions, for every step of the chunk or one for all; that of
    padded dimensions is 0, so that what a choice leads to is certain.

    Args:
        steerable: the policy or its adapter, see `Steerable`.
        shape: of the actor.
    """

    def __init__(self, steerable: Any, shape: SteeringShape) -> None:
        super().__init__()
        self.steerable, self.shape = steerable, shape
        self.policy = getattr(steerable, "policy", steerable)
        self.config, self.observation_steps = self.policy.config, observation_steps(steerable)
        self._action_dims = self.config.action_feature.shape[0]
        steps = 1 if shape.noise_repeat else steerable.shape[0]
        self.dims = steps * self._action_dims
        device = next(self.policy.parameters()).device
        self.actor = NoiseActor(shape.features, self.dims, shape.hidden_width).to(device)
        self.whitening = Whitening(shape.features).to(device)

    def observe(self, batch: Batch) -> tuple[Any, Tensor]:
        """Return what the policy makes of an observation, and what the actor reads of it (B, F)."""
        context, features = self.steerable.observe(batch)
        if self.shape.observation == "state":
            features = state_features(self.steerable, batch)
        return context, features.detach().float()

    def denoise(self, context: Any, choice: Tensor) -> Tensor:
        """Return the policy's actions (B, n, A), normalised, on choices (B, d) in [-1, 1]."""
        steps, dims = self.steerable.shape
        noise = choice.new_zeros(len(choice), steps, dims)
        # One step's noise is broadcast over the chunk.
        noise[..., : self._action_dims] = self.shape.noise_magnitude * choice.reshape(
            len(choice), -1, self._action_dims
        )
        return self.steerable.denoise(context, noise)

    def prior(self, count: int, generator: torch.Generator | None = None) -> Tensor:
        """Draw choices (count, d) as the frozen policy would: N(0, 1), as far as it lies in the box."""
        device = self.whitening.mean.device
        b = self.shape.noise_magnitude
        uniform = torch.rand(count, self.dims, generator=generator, device=device, dtype=torch.float64)
        normal = math.sqrt(2.0) * torch.erfinv(math.erf(b / math.sqrt(2.0)) * (2.0 * uniform - 1.0))
        return (normal / b).float()

    @torch.no_grad()
    def sample_actions(
        self, batch: Batch, *, temperature: float = 1.0, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """See `TrainablePolicy`: the temperature is a factor of the actor's deviation, the trace its choice."""
        context, features = self.observe(batch)
        choice, log_prob = self.actor(self.whitening(features), temperature, generator)
        actions = self.denoise(context, choice)
        return {"actions": actions, "trace": choice, "log_prob": log_prob, "value": torch.zeros_like(log_prob)}

    def _save_pretrained(self, save_directory: Path) -> None:
        """Write the actor into a policy's folder; `save_pretrained` and `push_to_hub` are LeRobot's."""
        own = {name: tensor for name, tensor in self.state_dict().items() if name.startswith(OWN)}
        tensors = {name: tensor.cpu().contiguous() for name, tensor in own.items()}
        save_file(tensors, save_directory / STEERING, {"shape": json.dumps(asdict(self.shape))})


def with_steering(policy: Any, folder: Path | None) -> Any:
    """Return `policy`, or what steers it if an actor lies in its folder.

    Args:
        policy: a LeRobot policy on its device.
        folder: that it was loaded from, if any.

    Raises:
        ValueError: the actor is damaged or of another policy.
    """
    if folder is None or not (path := Path(folder) / STEERING).is_file():
        return policy
    try:
        with safe_open(path, "pt") as file:
            shape = SteeringShape(**json.loads(file.metadata()["shape"]))
        steered = SteeredPolicy(make_steerable(policy), shape)
        steered.load_state_dict(load_file(path), strict=False)
    except (RuntimeError, SafetensorError) as error:
        raise ValueError(f"{path} is damaged, or of another policy: {error}") from error
    logging.info(f"The actor in {path} chooses the policy's noise; LeRobot's own commands play it without.")
    return steered


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


def blank_columns(policy: Any) -> Columns:
    """One observation in which there is nothing: zeros (1, ...) for all that `policy` reads."""
    columns: Columns = {}
    history = (steps,) if (steps := observation_steps(policy)) > 1 else ()
    for name, feature in (policy.config.input_features or {}).items():
        shape, kind = feature.shape, np.float32
        if name.startswith(OBS_IMAGES):
            shape, kind = (*shape[1:], shape[0]), np.uint8
        columns[name] = np.zeros((1, *history, *shape), kind)
    return columns
