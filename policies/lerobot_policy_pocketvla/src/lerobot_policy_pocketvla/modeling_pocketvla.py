"""The PocketVLA policy: its networks, and what an actor-critic trainer needs whatever the head."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE, OBS_STR
from torch import Tensor, nn

from lerobot_policy_pocketvla.configuration_pocketvla import PocketVLAConfig
from lerobot_policy_pocketvla.networks import StateNetwork, ValueHead
from lerobot_policy_pocketvla.pose_encoder import PoseEncoder
from lerobot_policy_pocketvla.precision import use_bfloat16

Batch = Mapping[str, Any]
"""A batch after the preprocessor: `observation.images.<camera>` (B, 3, H, W), uint8 or floats in [0, 1];
`observation.state` (B, P) and `observation.environment_state` (B, E), normalised; `task`, B strings."""


ENCODING = f"{OBS_STR}.encoding"
"""Key of what the picture encoder said, see `PocketVLAPolicy.encode_observation`."""


class PocketVLAPolicy(PreTrainedPolicy):
    """Actor and critic, two networks alike; see `PocketVLAConfig` for what each of them sees.

    From pictures, an encoder says where the bodies are, and the actor reads that as it would read the truth.

    `PocketVLAPolicy(config)` is the subclass for the config's head: what a policy can do depends on it.

    Args:
        config: the policy's.

    Raises:
        ValueError: when the configuration's features lack an input that it asks for.
    """

    config_class = PocketVLAConfig  # ty: ignore[invalid-assignment]
    name = "pocketvla"  # ty: ignore[invalid-assignment]
    takes_uint8_images = True
    """Camera frames may come as they are, in 0..255: converting them to floats costs as much as a convolution."""
    by_head: ClassVar[dict[str, type[PocketVLAPolicy]]] = {}
    """The subclasses by the config's `head`."""

    def __init_subclass__(cls, heads: tuple[str, ...] = (), **kwargs: Any) -> None:
        """Register a subclass as the policy of some heads."""
        super().__init_subclass__(**kwargs)
        cls.by_head.update(dict.fromkeys(heads, cls))

    def __new__(cls, config: PocketVLAConfig | None = None, **kwargs: Any) -> PocketVLAPolicy:
        """Choose the class; a copy is made of its class, without a config."""
        chosen = cls.by_head[config.head] if cls is PocketVLAPolicy and config is not None else cls
        return super().__new__(chosen)

    def __init__(self, config: PocketVLAConfig, **kwargs: Any) -> None:
        """Build the networks; LeRobot's further arguments (data set statistics, metadata) are not needed."""
        super().__init__(config)
        config.validate_features()
        self.config: PocketVLAConfig = config
        self.encoder = self._build_encoder() if config.actor_observation == "image" else None
        sizes = (config.hidden_width, config.hidden_depth, config.task_width, config.vocabulary_size)
        seen = self.encoder.width if self.encoder else config.environment_state_width
        self.actor = StateNetwork(config.state_width + seen, *sizes)
        self.head = self._build_head()
        # What each of them sees besides the proprioception.
        self.actor_key = ENCODING if self.encoder else OBS_ENV_STATE
        privileged = config.critic_observation == "environment_state"
        self.critic_key = OBS_ENV_STATE if privileged else self.actor_key
        judged = config.environment_state_width if privileged else seen
        self.critic = StateNetwork(config.state_width + judged, *sizes)
        self.value_head = ValueHead(config.hidden_width, config.value_width)
        self.to(config.device)

    @abstractmethod
    def _build_head(self) -> nn.Module:
        """The layers from the actor's features (B, hidden_width) on."""

    def _build_encoder(self) -> PoseEncoder:
        config = self.config
        return PoseEncoder(
            config.state_width,
            config.hand,
            config.view,
            config.camera[1][1:],
            use_bfloat16(config.dtype, config.device or "cpu"),
        )

    # What the networks are fed.

    def _vector(self, batch: Batch, environment: str | None) -> Tensor:
        keys = [OBS_STATE] * bool(self.config.state_width) + ([environment] if environment else [])
        if not keys:
            return torch.zeros(len(self._texts(batch)), 0, device=self.value_head.out.weight.device)
        return torch.cat([batch[key] for key in keys], dim=-1)

    @staticmethod
    def _texts(batch: Batch) -> list[str]:
        texts = batch["task"]
        return [texts] if isinstance(texts, str) else list(texts)

    def _features(self, batch: Batch) -> Tensor:
        """Actor features, (B, hidden_width)."""
        batch = self._with_encoding(batch)
        return self.actor(self._vector(batch, self.actor_key), self._texts(batch))

    def _cloning_features(self, batch: Batch) -> tuple[Tensor, Tensor, dict[str, float]]:
        """Actor features (B, hidden_width), what the encoder is taught (B,), and numbers for the log.

        An encoder that says where the bodies are is taught that alone, by batches that hold the truth, and the
        actor learns to act on what it says. The actor's loss trains any other encoder.
        """
        if self.encoder and self.training and ENCODING not in batch:
            self.encoder.count_in(self._pictures(batch))
        encoder = self.encoder if self.encoder and self.encoder.num_bodies else None
        if encoder and OBS_ENV_STATE in batch and ENCODING not in batch:
            found, losses, distances = encoder.teach(
                self._pictures(batch), self._vector(batch, None), batch[OBS_ENV_STATE]
            )
            features = self._features({**batch, ENCODING: found.detach()})
            return features, losses, {"pose_error_mm": 1000 * float(distances.mean())}
        features = self._features(self._encoded(batch) if encoder else batch)
        return features, features.new_zeros(len(features)), {}

    def _with_encoding(self, batch: Batch) -> Batch:
        """The batch with what the encoder says of its pictures, if the policy sees any."""
        if self.encoder is None or ENCODING in batch:
            return batch
        found = self.encoder(self._pictures(batch), self._vector(batch, None))
        return {key: value for key, value in batch.items() if key != self.config.camera[0]} | {ENCODING: found}

    def _pictures(self, batch: Batch) -> Tensor:
        key, (channels, height, width) = self.config.camera
        images = batch[key]
        if images.ndim != 4 or images.shape[1:] != (channels, height, width):
            raise ValueError(
                f"{key} has shape {tuple(images.shape)}, but this policy was trained at (batch, {channels}, "
                f"{height}, {width}), height and width last. Render or resize to {height} x {width}, or train a "
                "policy at the other size."
            )
        return images

    def _values(self, batch: Batch) -> Tensor:
        """Values (B,). The value loss never trains the encoder."""
        if self.critic_key == ENCODING:
            batch = self._with_encoding(batch)
            batch = {**batch, ENCODING: batch[ENCODING].detach()}
        return self.value_head(self.critic(self._vector(batch, self.critic_key), self._texts(batch)))

    def _full_precision(self) -> torch.autocast:
        """Switch off a caller's autocast: only the convolutions may run in bfloat16."""
        return torch.autocast(self.value_head.out.weight.device.type, enabled=False)

    # LeRobot's policy interface.

    def get_optim_params(self) -> list[dict[str, Any]]:  # ty: ignore[incompatible-method-override]
        """Parameter groups for behaviour cloning: encoder and actor, of the actor only matrices decay.

        The fused step: the other one takes MKL's root, whose last bits depend on the processor.
        """
        matrices, others, sigmas = [], [], []
        for name, parameter in [*self.actor.named_parameters(), *self.head.named_parameters()]:
            if name == "raw_sigma":
                sigmas.append(parameter)
            elif parameter.ndim < 2 or "embedding" in name:
                others.append(parameter)
            else:
                matrices.append(parameter)
        groups = [{"params": matrices}, {"params": others, "weight_decay": 0.0}]
        if sigmas:
            groups.append({"params": sigmas, "weight_decay": 0.0, "lr": self.config.optimizer_sigma_lr})
        if self.encoder:
            groups.append({"params": list(self.encoder.parameters())})
        return [group | {"fused": True} for group in groups]

    # What an actor-critic trainer needs (structurally; nothing is imported from it).

    @property
    def encode_observation(self) -> Callable[[Batch], Batch] | None:
        """With `freeze_encoder`, the function that replaces a batch's images by encodings; else None."""
        return self._encoded if self.encoder and self.config.freeze_encoder else None

    @torch.no_grad()
    def _encoded(self, batch: Batch) -> Batch:
        with self._full_precision():
            return self._with_encoding(batch)

    @torch.no_grad()
    def value_inputs(self, batch: Batch) -> Batch:
        """What the critic, which is a network of its own, sees of a batch."""
        with self._full_precision():
            batch = self._with_encoding(batch) if self.critic_key == ENCODING else batch
        return {key: value for key, value in batch.items() if key in ("task", OBS_STATE, self.critic_key)}

    def predict_values(self, batch: Batch) -> Tensor:
        """Values of the observations, (B,), differentiable."""
        with self._full_precision():
            return self._values(batch)

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """Two disjoint groups, `policy` and `value`; they hold every parameter but those of a frozen encoder."""
        policy = [*self.actor.parameters(), *self.head.parameters()]
        if self.encoder and not self.config.freeze_encoder:
            policy += self.encoder.parameters()
        value = [*self.critic.parameters(), *self.value_head.parameters()]
        return [{"name": "policy", "params": policy}, {"name": "value", "params": value}]
