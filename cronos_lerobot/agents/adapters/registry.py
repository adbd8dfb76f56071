"""Adapters by policy type, open to users as agents are."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from cronos_lerobot.agents.base import Batch, check_trainable, is_trainable


@dataclass(frozen=True)
class AdapterOptions:
    """What an agent asks of an adapter."""

    noise_std: float = 0.1
    """Standard deviation at the start, in normalised units, of the noise that an adapter adds to actions; the
    least deviation of a diffusion's step."""
    noise_level: float = 0.5
    """Noise of a flow policy's denoising; 0 has none, 1 about that of the policy's own first noise. Of a
    diffusion policy DDIM's eta."""
    noise_steps: int | None = None
    """At how many steps of a flow policy's denoising there is noise; None is all."""


class Adapter(nn.Module):
    """A TrainablePolicy around a LeRobot policy: the policy acts and is saved, the rest is beside it.

    Args:
        policy: the LeRobot policy; the adapter trains its parameters in place.

    Attributes:
        policy: the same.
        decision_steps: how many actions it decides on at once.
        observation_steps: how many observations it looks at.
        options_read: names of the AdapterOptions that it follows; the others are refused where they are given.
        has_entropy: whether its decisions have an entropy that depends on the policy.
        is_chain: whether the factors of a decision are the steps of a denoising chain.
    """

    decision_steps: int = 1
    observation_steps: int = 1
    options_read: frozenset[str] = frozenset(field.name for field in fields(AdapterOptions))
    has_entropy: bool = True
    is_chain: bool = False

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy = policy
        self.config = policy.config

    @property
    def encode_observation(self) -> Callable[[Batch], Batch] | None:
        """The policy's own, if it has one: `observe` and the like take what it returns."""
        return getattr(self.policy, "encode_observation", None)

    def instruction(self, text: str) -> str:
        """Return the instruction in what the policy's preprocessor made of it."""
        return text

    def own_parameters(self) -> dict[str, Tensor]:
        """What is not the policy's, without gradient: noise scales, the critic, with the buffers that are saved.

        A run's checkpoint holds it.
        """
        saved = self.state_dict(keep_vars=True).keys()
        buffers = {name: buffer for name, buffer in self.named_buffers() if name in saved}
        tensors = dict(self.named_parameters()) | buffers
        return {name: tensor.detach() for name, tensor in tensors.items() if not name.startswith("policy.")}

    @torch.no_grad()
    def load_own_parameters(self, parameters: dict[str, Tensor]) -> None:
        """Go on with `own_parameters` of a checkpoint.

        Raises:
            ValueError: they are those of another adapter.
        """
        own = self.own_parameters()
        if own.keys() != parameters.keys():
            raise ValueError(f"The adapter's parameters are {sorted(own)}, those saved are {sorted(parameters)}.")
        for name, param in parameters.items():
            own[name].copy_(param)


@runtime_checkable
class Steerable(Protocol):
    """A policy, or an adapter, whose actions follow from a noise that can be chosen: a flow or a diffusion."""

    decision_steps: int
    """n, how many actions it decides on at once."""
    shape: tuple[int, int]
    """(H, D) of the noise of a chunk; dimensions beyond those of the action are padding."""

    def observe(self, batch: Batch) -> tuple[Any, Tensor]:
        """Return what `denoise` needs of an observation, in any type, and its features (B, F), detached."""
        ...

    def denoise(self, context: Any, noise: Tensor) -> Tensor:
        """Return the actions (B, n, A), normalised, that the policy itself makes of a noise (B, H, D)."""
        ...


AdapterFactory = Callable[[Any, AdapterOptions], Adapter]

ADAPTERS: dict[str, AdapterFactory] = {}
"""What makes a LeRobot policy of a type trainable."""


def register_adapter(policy_type: str) -> Callable[[AdapterFactory], AdapterFactory]:
    """Make policies of a `--policy.type` trainable by agents that need likelihoods.

    It decorates an Adapter whose constructor, or a function that, takes the policy and AdapterOptions.

    Raises:
        ValueError: the type has an adapter.
    """

    def register(factory: AdapterFactory) -> AdapterFactory:
        if policy_type in ADAPTERS:
            raise ValueError(f"there is an adapter for {policy_type!r} already; types: {sorted(ADAPTERS)}.")
        ADAPTERS[policy_type] = factory
        return factory

    return register


def make_trainable(policy: Any, options: AdapterOptions) -> Any:
    """Return `policy` if it is a TrainablePolicy, or its adapter.

    Raises:
        ValueError: it is neither; the message says who can train it all the same.
    """
    if is_trainable(policy):
        return policy
    policy_type = getattr(policy.config, "type", None)
    if policy_type in ADAPTERS:
        return ADAPTERS[policy_type](policy, options)
    try:
        check_trainable(policy)
    except TypeError as error:
        raise ValueError(
            f"{error} There are adapters for --policy.type={', '.join(sorted(ADAPTERS))}; one of your own is "
            "registered by a package that --discover_packages_path=<package> imports. "
            "--algorithm.type=imitation learns with any policy that lerobot-train trains."
        ) from error
    return policy


def make_steerable(policy: Any) -> Any:
    """Return `policy` if it is Steerable, or its adapter.

    Raises:
        ValueError: neither is; the message names the types of policies that are.
    """
    policy_type = getattr(policy.config, "type", None)
    if isinstance(policy, Steerable):
        return policy
    if policy_type in ADAPTERS and isinstance(
        adapter := ADAPTERS[policy_type](policy, AdapterOptions()), Steerable
    ):
        return adapter
    types = sorted(name for name, factory in ADAPTERS.items() if hasattr(factory, "denoise"))
    raise ValueError(
        f"--policy.type={policy_type} has no noise that could be chosen: --algorithm.type=steering is for flow "
        f"and diffusion policies, {', '.join(types)}. Others learn with --algorithm.type=ppo or imitation."
    )


def trained_tensors(policy: Any) -> Iterable[Tensor]:
    """The parameters of a trainable policy, those beside an adapter's among them, that have a gradient."""
    return (param for param in policy.parameters() if param.requires_grad)
