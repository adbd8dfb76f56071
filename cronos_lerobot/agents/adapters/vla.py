"""Vision-language-action policies with a flow head.

SmolVLA (Shukor et al., 2025), pi0 (Black et al., 2024) and pi0.5 (Physical Intelligence, 2025).
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any

import torch
from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor, nn

from cronos_lerobot.agents.adapters.flow import FlowAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions, register_adapter
from cronos_lerobot.agents.base import Batch
from cronos_lerobot.agents.weights import unwrapped


@dataclass(frozen=True)
class Prefix:
    """Images and instruction as the vision-language model reads them, once for an observation."""

    hidden: Tensor
    """(B, L, D), its last hidden states."""
    mask: Tensor
    """(B, L) bool, which of the L tokens are no padding."""
    cache: Any
    """Keys and values of its layers."""
    given: dict[str, Tensor] = field(default_factory=dict)
    """What else LeRobot's `denoise_step` takes."""


class VLAAdapter(FlowAdapter):
    """A decision is the chain of a chunk; a critic on the vision-language model's output and the robot's state.

    The critic reads the mean of the last hidden states, as in pi_RL (Chen et al., 2025) that of pi0.5; that of
    pi0 there reads the action expert instead, because the prefix does not have the state, which it gets here
    beside it: a value then costs no denoising. What LeRobot's config or PEFT freezes stays frozen; the prefix has
    a gradient only if one of its parameters has.

    Args:
        policy: the LeRobot policy on its device, PEFT's wrapper around it perhaps.
        options: of the noise.
        num_steps: of the denoising.
        width: D, of the vision-language model.
    """

    def __init__(self, policy: Any, options: AdapterOptions, *, num_steps: int, width: int) -> None:
        config = policy.config
        state = config.input_features[OBS_STATE].shape[0]
        shape = (config.chunk_size, config.max_action_dim)
        super().__init__(policy, options, shape=shape, num_steps=num_steps, feature_width=width + state)

    @abstractmethod
    def read(self, batch: Batch) -> Prefix:
        """Return what the vision-language model makes of an observation."""

    @abstractmethod
    def prefix_parameters(self) -> Iterable[nn.Parameter]:
        """What `read` depends on."""

    @property
    def lerobot_policy(self) -> Any:
        """The LeRobot policy, without PEFT's wrapper."""
        return unwrapped(self.policy)

    def observe(self, batch: Batch) -> tuple[Prefix, Tensor]:
        """See `FlowAdapter`."""
        trained = any(param.requires_grad for param in self.prefix_parameters())
        with torch.set_grad_enabled(trained and torch.is_grad_enabled()):
            prefix = self.read(batch)
        mask = prefix.mask[..., None]
        mean = (prefix.hidden.detach().float() * mask).sum(1) / mask.sum(1)
        return prefix, torch.cat([mean, batch[OBS_STATE]], dim=1)

    def velocity(self, context: Prefix, x: Tensor, time: Tensor) -> Tensor:
        """See `FlowAdapter`."""
        return self.lerobot_policy.model.denoise_step(
            prefix_pad_masks=context.mask, past_key_values=context.cache, x_t=x, timestep=time, **context.given
        )


@register_adapter("smolvla")
class SmolVLAAdapter(VLAAdapter):
    """Its state is a token of the prefix; while `--policy.train_state_proj`, the prefix has a gradient.

    Raises:
        ValueError: the policy acts in Aloha's joint space.
    """

    def __init__(self, policy: Any, options: AdapterOptions) -> None:
        config = policy.config
        if config.adapt_to_pi_aloha:
            raise ValueError(
                "--policy.adapt_to_pi_aloha=true turns actions into Aloha's joint angles, which are not played "
                "here: train with --policy.adapt_to_pi_aloha=false."
            )
        width = unwrapped(policy).model.vlm_with_expert.config.text_config.hidden_size
        super().__init__(policy, options, num_steps=config.num_steps, width=width)

    def read(self, batch: Batch) -> Prefix:
        """See `VLAAdapter`."""
        policy = self.lerobot_policy
        images, image_masks = policy.prepare_images(batch)
        embedded, mask, attention = policy.model.embed_prefix(
            images, image_masks, batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK],
            state=policy.prepare_state(batch),
        )  # fmt: skip
        (hidden, _), cache = policy.model.vlm_with_expert.forward(
            attention_mask=make_att_2d_masks(mask, attention),
            position_ids=torch.cumsum(mask, dim=1) - 1,
            inputs_embeds=[embedded, None],
            use_cache=self.config.use_cache,
        )
        return Prefix(hidden, mask, cache)

    def prefix_parameters(self) -> Iterable[nn.Parameter]:
        """See `VLAAdapter`."""
        model = self.lerobot_policy.model
        return chain(model.vlm_with_expert.vlm.parameters(), model.state_proj.parameters())


class PaliGemmaAdapter(VLAAdapter):
    """What pi0 and pi0.5 have in common."""

    def __init__(self, policy: Any, options: AdapterOptions) -> None:
        width = unwrapped(policy).model.paligemma_with_expert.paligemma.config.text_config.hidden_size
        super().__init__(policy, options, num_steps=policy.config.num_inference_steps, width=width)

    def read(self, batch: Batch) -> Prefix:
        """See `VLAAdapter`."""
        policy = self.lerobot_policy
        images, image_masks = policy._preprocess_images(batch)
        embedded, mask, attention = policy.model.embed_prefix(
            images, image_masks, batch[OBS_LANGUAGE_TOKENS], batch[OBS_LANGUAGE_ATTENTION_MASK]
        )
        # As LeRobot does before it acts: its masks are those of this attention.
        self._language_model.config._attn_implementation = "eager"
        (hidden, _), cache = policy.model.paligemma_with_expert.forward(
            attention_mask=prepare_attention_masks_4d(make_att_2d_masks(mask, attention)),
            position_ids=torch.cumsum(mask, dim=1) - 1,
            inputs_embeds=[embedded, None],
            use_cache=True,
        )
        return Prefix(hidden, mask, cache)

    def prefix_parameters(self) -> Iterable[nn.Parameter]:
        """See `VLAAdapter`."""
        return self.lerobot_policy.model.paligemma_with_expert.paligemma.parameters()

    def policy_parameters(self) -> list[nn.Parameter]:
        """See `FlowAdapter`; without the heads that predict words, which no action depends on."""
        return [p for name, p in self.policy.named_parameters() if p.requires_grad and ".lm_head." not in name]

    @property
    def _language_model(self) -> Any:
        return self.lerobot_policy.model.paligemma_with_expert.paligemma.model.language_model


@register_adapter("pi0")
class PI0Adapter(PaliGemmaAdapter):
    """pi0's action expert reads the robot's state at each step of the denoising."""

    def read(self, batch: Batch) -> Prefix:
        """See `VLAAdapter`."""
        return replace(super().read(batch), given={"state": self.lerobot_policy.prepare_state(batch)})


@register_adapter("pi05")
class PI05Adapter(PaliGemmaAdapter):
    """pi0.5 reads the robot's state as words of its prompt, which its preprocessor writes."""

    def instruction(self, text: str) -> str:
        """See `Adapter`."""
        found = re.fullmatch(r"Task: (.*), State: [-\d ]*;\nAction: ", text)
        return found[1] if found else text
