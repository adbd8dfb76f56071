"""pi0 (Black et al., 2024) and pi0.5 (Physical Intelligence, 2025), whose flow becomes a stochastic chain."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import torch
from lerobot.policies.common.vla_utils import make_att_2d_masks, prepare_attention_masks_4d
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import nn

from cronos_lerobot.agents.adapters.registry import AdapterOptions, register_adapter
from cronos_lerobot.agents.adapters.vla import Prefix, VLAAdapter
from cronos_lerobot.agents.base import Batch
from cronos_lerobot.agents.weights import unwrapped


class PaliGemmaAdapter(VLAAdapter):
    """What pi0 and pi0.5 have in common.

    Args:
        policy: a PI0Policy or PI05Policy on its device.
        options: of the noise.
    """

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
