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
from lerobot_policy_pocketvla.images import check_image_size, random_shift
from lerobot_policy_pocketvla.networks import ImageNetwork, StateNetwork, ValueHead
from lerobot_policy_pocketvla.precision import use_bfloat16

Batch = Mapping[str, Any]
"""A batch after the preprocessor: `observation.images.<camera>` (B, 3, H, W), uint8 or floats in [0, 1];
`observation.state` (B, P) and `observation.environment_state` (B, E), normalised; `task`, B strings."""


ENCODING = f"{OBS_STR}.encoding"
"""Key of a cached encoding in a batch, see `PocketVLAPolicy.encode_observation`."""
FEATURES = f"{OBS_STR}.features"
"""Key of the actor's cached features in a batch, see `PocketVLAPolicy.value_inputs`."""


class PocketVLAPolicy(PreTrainedPolicy):
    """Actor and critic; see `PocketVLAConfig` for what each of them sees.

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
        self.uses_images = config.actor_observation == "image"
        sizes = (config.hidden_width, config.hidden_depth, config.task_width, config.vocabulary_size)
        if self.uses_images:
            bfloat16 = use_bfloat16(config.dtype, config.device or "cpu")
            self.actor: nn.Module = ImageNetwork(config.state_width, *sizes, config.keypoints, bfloat16)
        else:
            self.actor = StateNetwork(config.state_width + config.environment_state_width, *sizes)
        self.head = self._build_head()
        # A critic that sees a vector has a network of its own; one that sees the image reads the actor's.
        self.critic: nn.Module | None = None
        if config.critic_observation == "environment_state" or not self.uses_images:
            self.critic = StateNetwork(config.state_width + config.environment_state_width, *sizes)
        self.value_head = ValueHead(config.hidden_width, config.value_width)
        self.to(config.device)

    @abstractmethod
    def _build_head(self) -> nn.Module:
        """The layers from the actor's features (B, hidden_width) on."""

    # What the networks are fed.

    def _vector(self, batch: Batch, with_environment: bool) -> Tensor:
        keys = [OBS_STATE] * bool(self.config.state_width) + [OBS_ENV_STATE] * with_environment
        if not keys:
            return torch.zeros(len(self._texts(batch)), 0, device=self.value_head.out.weight.device)
        return torch.cat([batch[key] for key in keys], dim=-1)

    @staticmethod
    def _texts(batch: Batch) -> list[str]:
        texts = batch["task"]
        return [texts] if isinstance(texts, str) else list(texts)

    def _features(self, batch: Batch, shift_px: int = 0) -> Tensor:
        """Actor features, (B, hidden_width)."""
        if not self.uses_images:
            return self.actor(self._vector(batch, with_environment=True), self._texts(batch))
        encoding = batch[ENCODING] if ENCODING in batch else self._encode(batch, shift_px)
        return self.actor(encoding, self._vector(batch, with_environment=False), self._texts(batch))

    def _encode(self, batch: Batch, shift_px: int = 0) -> Tensor:
        """What the image encoder says of the batch's images, (B, encoder.width)."""
        assert isinstance(self.actor, ImageNetwork)
        key, shape = self.config.camera
        check_image_size(batch[key], shape, key)
        return self.actor.encode(random_shift(batch[key], shift_px), self._texts(batch))

    def _values(self, batch: Batch, features: Tensor | None) -> Tensor:
        """Values (B,); `features` are the actor's, if they are at hand."""
        if self.critic is not None:
            return self.value_head(self.critic(self._vector(batch, with_environment=True), self._texts(batch)))
        if features is None:
            features = batch[FEATURES] if FEATURES in batch else self._features(batch)
        return self.value_head(features.detach() if self.config.value_detach else features)

    def _full_precision(self) -> torch.autocast:
        """Switch off a caller's autocast: only the convolutions may run in bfloat16."""
        return torch.autocast(self.value_head.out.weight.device.type, enabled=False)

    # LeRobot's policy interface.

    def get_optim_params(self) -> list[dict[str, Any]]:  # ty: ignore[incompatible-method-override]
        """Parameter groups for behaviour cloning: the actor's, weight decay on its matrices only.

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
        return [group | {"fused": True} for group in groups]

    # What an actor-critic trainer needs (structurally; nothing is imported from it).

    @property
    def encode_observation(self) -> Callable[[Batch], Batch] | None:
        """With `freeze_encoder`, the function that puts encodings in place of a batch's images; else None."""
        return self._with_encoding if self.uses_images and self.config.freeze_encoder else None

    @torch.no_grad()
    def _with_encoding(self, batch: Batch) -> Batch:
        with self._full_precision():
            kept = {key: value for key, value in batch.items() if key != self.config.camera[0]}
            return kept | {ENCODING: self._encode(batch)}

    @property
    def value_inputs(self) -> Callable[[Batch], Batch] | None:
        """The function that makes of a batch what the value's own parameters begin with: the inputs of a critic
        of its own, or the actor's features; None if the value loss trains the actor, too."""
        if self.critic is not None:
            return self._critic_inputs
        return self._actor_features if self.config.value_detach else None

    def _critic_inputs(self, batch: Batch) -> Batch:
        return {key: value for key, value in batch.items() if key in ("task", OBS_STATE, OBS_ENV_STATE)}

    @torch.no_grad()
    def _actor_features(self, batch: Batch) -> Batch:
        with self._full_precision():
            return {FEATURES: self._features(batch)}

    def predict_values(self, batch: Batch) -> Tensor:
        """Values of the observations, (B,), differentiable."""
        with self._full_precision():
            return self._values(batch, None)

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """Two disjoint groups, `policy` and `value`; they hold every parameter but those of a frozen encoder."""
        value = list(self.value_head.parameters())
        if self.critic is not None:
            value += list(self.critic.parameters())
        actor = self.actor
        if self.config.freeze_encoder and isinstance(actor, ImageNetwork):
            actor = actor.trunk
        policy = [*actor.parameters(), *self.head.parameters()]
        return [{"name": "policy", "params": policy}, {"name": "value", "params": value}]
