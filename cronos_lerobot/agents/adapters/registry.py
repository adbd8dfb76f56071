"""Adapters by policy type, open to users as agents are."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from cronos_lerobot.agents.base import Batch, missing_methods
from cronos_lerobot.registry import Registry

FEATURES = "features"
"""What a critic reads, in a batch that `value_inputs` made."""


class Critic(nn.Module):
    """Features (B, F) to values (B,), 0 at the start.

    Args:
        features: F.
        width: of the two hidden layers.
    """

    def __init__(self, features: int, width: int = 256) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.LayerNorm(features), nn.Linear(features, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, 1),
        )  # fmt: skip
        last = self.layers[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, features: Tensor) -> Tensor:
        """See above."""
        return self.layers(features.to(torch.float32)).squeeze(-1)


@dataclass(frozen=True)
class AdapterOptions:
    """What an agent asks of an adapter."""

    noise_std: float = 0.1
    """Standard deviation, in normalised units, of the noise that an adapter adds to actions, at the start where it
    is learned; the least deviation of a diffusion's step."""
    noise_level: float = 1.0
    """DDIM's eta of the denoising of a flow or diffusion policy, 0 (no noise) to 1 (that of DDPM)."""
    noise_steps: int | None = None
    """At how many steps of a flow policy's denoising there is noise; None is all but the last."""
    noise_repeat: bool = False
    """A flow policy has no noise in its denoising, but one action's, of `noise_std`, for the whole chunk."""


class Adapter(nn.Module):
    """A TrainablePolicy around a LeRobot policy: the policy acts and is saved, the rest is beside it.

    Args:
        policy: the LeRobot policy; the adapter trains its parameters in place.

    Attributes:
        policy: the same.
        decision_steps: how many actions it decides on at once.
        observation_steps: how many observations it looks at.
    """

    decision_steps: int = 1
    observation_steps: int = 1

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
        """Go on with `own_parameters` of a checkpoint."""
        for name, param in self.own_parameters().items():
            param.copy_(parameters[name])


class CriticAdapter(Adapter):
    """An adapter with a critic of its own, whose loss does not train the policy.

    Args:
        policy: see `Adapter`.
        feature_width: F, of what the critic reads; None if the subclass has values of another kind.
    """

    def __init__(self, policy: Any, feature_width: int | None) -> None:
        super().__init__(policy)
        if feature_width is not None:
            self.critic = Critic(feature_width).to(next(policy.parameters()).device)

    @abstractmethod
    def features(self, batch: Batch) -> Tensor:
        """Return what the critic reads (B, F), detached."""

    def policy_parameters(self) -> list[nn.Parameter]:
        """What the policy's loss trains."""
        return [param for param in self.policy.parameters() if param.requires_grad]

    @torch.no_grad()
    def value_inputs(self, batch: Batch) -> Batch:
        """What the critic reads; as it is, if that is what the batch holds."""
        return batch if FEATURES in batch else {FEATURES: self.features(batch)}

    def predict_values(self, batch: Batch) -> Tensor:
        """See `TrainablePolicy`."""
        return self.critic(self.value_inputs(batch)[FEATURES])

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """See `TrainablePolicy`."""
        return [
            {"name": "policy", "params": self.policy_parameters()},
            {"name": "value", "params": [*self.critic.parameters()]},
        ]


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

ADAPTERS: Registry[AdapterFactory] = Registry("--policy.type", "cronos_lerobot.register_adapter")
"""What makes a LeRobot policy of a type trainable."""


def register_adapter(policy_type: str) -> Callable[[AdapterFactory], AdapterFactory]:
    """Make policies of a `--policy.type` trainable by agents that need likelihoods.

    It decorates an Adapter whose constructor, or a function that, takes the policy and AdapterOptions.

    Raises:
        ValueError: the type has an adapter.
    """

    return ADAPTERS.register(policy_type)


def make_trainable(policy: Any, options: AdapterOptions) -> Any:
    """Return `policy` if it is a TrainablePolicy, or its adapter.

    Raises:
        ValueError: it is neither; the message says who can train it all the same.
    """
    if not (missing := missing_methods(policy)):
        return policy
    policy_type = getattr(policy.config, "type", None)
    if policy_type in ADAPTERS:
        return ADAPTERS[policy_type](policy, options)
    raise ValueError(
        f"--policy.type={policy_type} cannot be trained by reinforcement: it has no {', '.join(missing)}, and no "
        f"adapter as {', '.join(sorted(ADAPTERS))} have. Register one of your own in a package that "
        "--discover_packages_path=<package> imports, or learn with --algorithm.type=imitation, which takes every "
        "policy that lerobot-train trains and lerobot-eval plays."
    )


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
