"""SmolVLA (Shukor et al., 2025), whose flow becomes a stochastic chain."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import Any

import torch
from lerobot.policies.common.vla_utils import make_att_2d_masks
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import nn

from cronos_lerobot.agents.adapters.registry import AdapterOptions, register_adapter
from cronos_lerobot.agents.adapters.vla import Prefix, VLAAdapter
from cronos_lerobot.agents.base import Batch
from cronos_lerobot.agents.weights import unwrapped


@register_adapter("smolvla")
class SmolVLAAdapter(VLAAdapter):
    """Its state is a token of the prefix; while `--policy.train_state_proj`, the prefix has a gradient.

    Args:
        policy: a SmolVLAPolicy on its device.
        options: of the noise.

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
