"""Prompts, images and action tokens as one sequence of Llama, and what it says of the action tokens.

The sequence is: beginning-of-sequence, the P projected patches, padding, the rest of the prompt, action tokens.
The padding, which makes the prompts of a batch equally long, is masked out and has no position of its own, so a
row's result does not depend on the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from transformers import StaticCache

from lerobot_policy_openvla.network import OpenVLANetwork


@dataclass(frozen=True)
class Prompts:
    """B prompts without their images."""

    bos: Tensor
    """(B, 1) int64."""
    rest: Tensor
    """(B, R) int64, padded on the left."""
    num_padding: Tensor
    """(B,) int64, how many of `rest` are padding."""

    @classmethod
    def of(cls, rows: Sequence[Sequence[int]], device: torch.device) -> Prompts:
        """Stack the tokens of B prompts."""
        longest = max(len(row) for row in rows)
        padding = [longest - len(row) for row in rows]
        # Any token will do for padding: it is masked out.
        rest = [[row[0]] * n + list(row[1:]) for row, n in zip(rows, padding, strict=True)]
        bos = torch.tensor([[row[0]] for row in rows], device=device)
        return cls(bos, torch.tensor(rest, device=device), torch.tensor(padding, device=device))

    def mask(self, num_patches: int, num_actions: int) -> Tensor | None:
        """Return what may be attended to, (B, L) int64; None if it is everything, which is faster."""
        if not self.num_padding.any():
            return None
        batch, device = len(self.bos), self.bos.device
        rest = torch.arange(self.rest.shape[1], device=device) >= self.num_padding[:, None]
        before = rest.new_ones(batch, 1 + num_patches)
        return torch.cat((before, rest, rest.new_ones(batch, num_actions)), dim=1).long()


def _positions(mask: Tensor | None) -> Tensor | None:
    return None if mask is None else (mask.cumsum(dim=1) - 1).clamp(min=0)


def _embed(network: OpenVLANetwork, prompts: Prompts, patches: Tensor, actions: Tensor | None) -> Tensor:
    bos, rest = network.embed_tokens(prompts.bos), network.embed_tokens(prompts.rest)
    parts = [bos, patches.to(bos.dtype), rest]
    if actions is not None:
        parts.append(network.embed_tokens(actions))
    return torch.cat(parts, dim=1)


def score_actions(
    network: OpenVLANetwork, prompts: Prompts, patches: Tensor, tokens: Tensor
) -> tuple[Tensor, Tensor]:
    """Run the whole sequence at once, as training does.

    Args:
        network: the network.
        prompts: B of them.
        patches: (B, P, text width), projected.
        tokens: action tokens (B, A); the last one is predicted, not read.

    Returns:
        Logits (B, A, V) float32 of each action token, and the last hidden state (B, text width) where the first
        of them is predicted.
    """
    num_actions = tokens.shape[1]
    mask = prompts.mask(patches.shape[1], num_actions - 1)
    hidden = network.language_model.model(
        inputs_embeds=_embed(network, prompts, patches, tokens[:, :-1]),
        attention_mask=mask,
        position_ids=_positions(mask),
        use_cache=False,
    ).last_hidden_state[:, -num_actions:]
    return network.language_model.lm_head(hidden).float(), hidden[:, 0]


def prompt_hidden(network: OpenVLANetwork, prompts: Prompts, patches: Tensor) -> Tensor:
    """Return the last hidden state (B, text width) where the first action token is predicted."""
    mask = prompts.mask(patches.shape[1], 0)
    output = network.language_model.model(
        inputs_embeds=_embed(network, prompts, patches, None),
        attention_mask=mask,
        position_ids=_positions(mask),
        use_cache=False,
    )
    return output.last_hidden_state[:, -1]


def generate_actions(
    network: OpenVLANetwork,
    prompts: Prompts,
    patches: Tensor,
    num_actions: int,
    choose: Callable[[Tensor, int], Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Choose `num_actions` tokens A one after the other; the prompt is read once and kept as keys and values.

    Args:
        network: the network.
        prompts: B of them.
        patches: (B, P, text width), projected.
        num_actions: A.
        choose: logits (B, V) float32 of the i-th token, and i -> tokens (B,).

    Returns:
        Tokens (B, A), logits (B, A, V) float32, and the hidden state (B, text width) of `score_actions`.
    """
    model, head = network.language_model.model, network.language_model.lm_head
    mask = prompts.mask(patches.shape[1], num_actions - 1)
    positions = _positions(mask)
    inputs, start = _embed(network, prompts, patches, None), 0
    # Room for all from the start: a cache that grows copies itself for every token.
    length = inputs.shape[1] + num_actions - 1
    cache = StaticCache(config=network.language_model.config, max_cache_len=length)
    tokens, logits, first = [], [], None
    for i in range(num_actions):
        stop = start + inputs.shape[1]
        hidden = model(
            inputs_embeds=inputs,
            attention_mask=None if mask is None else mask[:, :stop],
            position_ids=None if positions is None else positions[:, start:stop],
            past_key_values=cache,
            use_cache=True,
        ).last_hidden_state[:, -1]
        first = hidden if first is None else first
        logits.append(head(hidden).float())
        tokens.append(choose(logits[-1], i))
        inputs, start = network.embed_tokens(tokens[-1][:, None]), stop
    assert first is not None
    return torch.stack(tokens, dim=1), torch.stack(logits, dim=1), first
