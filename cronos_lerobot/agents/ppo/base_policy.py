"""The policy that a run began with, kept as the parameters that have changed since."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call


class BasePolicy:
    """What a policy was: it shares every parameter that is not trained, and every buffer, with what it is now.

    Args:
        policy: a TrainablePolicy.
        params: those of its parameters that will be trained and that the actions depend on; copied.

    Attributes:
        parameters: the copies by the policy's names of them; a checkpoint holds them.
    """

    def __init__(self, policy: nn.Module, params: Sequence[Tensor]) -> None:
        wanted = {id(param) for param in params}
        own = {name: param for name, param in policy.named_parameters() if id(param) in wanted}
        self.parameters = {name: param.detach().clone() for name, param in own.items()}
        names = {id(param): name for name, param in own.items()}
        self._evaluate = _Evaluate(policy)
        # Each attribute of each module once, whatever names it has: a policy may stand twice within its adapters,
        # and swapping it twice would put the copies back in the end.
        self._attributes = {
            f"{module_name}.{name}": names[id(param)]
            for module_name, module in self._evaluate.named_modules()
            for name, param in module.named_parameters(recurse=False, remove_duplicate=False)
            if id(param) in wanted
        }

    @torch.no_grad()
    def log_prob(self, batch: Any, trace: Tensor, temperature: float) -> Tensor:
        """Log-probability of decisions, (B,) or (B, L) [nats]."""
        parameters = {attribute: self.parameters[name] for attribute, name in self._attributes.items()}
        arguments = (batch, trace, temperature)
        return functional_call(self._evaluate, parameters, arguments, tie_weights=False)

    def load(self, parameters: dict[str, Tensor]) -> None:
        """Go on with the parameters of a checkpoint."""
        for name, param in self.parameters.items():
            param.copy_(parameters[name])


class _Evaluate(nn.Module):
    """`functional_call` calls `forward`."""

    def __init__(self, policy: Any) -> None:
        super().__init__()
        self.policy: Any = policy

    def forward(self, batch: Any, trace: Tensor, temperature: float) -> Tensor:
        return self.policy.evaluate_actions(batch, trace, temperature=temperature)["log_prob"]
