"""PocketVLA's flow head as a chain with noise. Its heads of tokens need no adapter."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from cronos_lerobot.agents.adapters.flow import FlowAdapter
from cronos_lerobot.agents.adapters.registry import AdapterOptions, register_adapter
from cronos_lerobot.agents.base import Batch


@register_adapter("pocketvla")
class PocketVLAFlowAdapter(FlowAdapter):
    """The policy has `flow_context` and `flow_velocity`. Values are its own, and saved with it.

    Raises:
        ValueError: the policy has another head.
    """

    def __init__(self, policy: Any, options: AdapterOptions) -> None:
        config = policy.config
        if not hasattr(policy, "flow_velocity"):
            raise ValueError(f"--policy.head={config.head} makes no actions of noise; --policy.head=flow does.")
        shape = (config.chunk_size, config.action_feature.shape[0])
        super().__init__(policy, options, shape=shape, num_steps=config.num_inference_steps, feature_width=None)

    def observe(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """See `FlowAdapter`; both are the policy's `flow_context`."""
        context = self.policy.flow_context(batch)
        return context, context.detach()

    def velocity(self, context: Tensor, x: Tensor, time: Tensor) -> Tensor:
        """See `FlowAdapter`."""
        return self.policy.flow_velocity(context, x, time)

    def actions(self, context: Tensor, x: Tensor) -> Tensor:
        """See `DenoisingAdapter`."""
        return self.policy.flow_actions(context, x)

    def values(self, batch: Batch, context: Tensor, features: Tensor) -> Tensor:
        """The policy's own."""
        return self.policy.predict_values(batch)

    def predict_values(self, batch: Batch) -> Tensor:
        """See `TrainablePolicy`."""
        return self.policy.predict_values(batch)

    @property
    def value_inputs(self) -> Callable[[Batch], Batch]:  # ty: ignore[incompatible-property-override]
        """See `TrainablePolicy`."""
        return self.policy.value_inputs

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """The policy's own: with `freeze_encoder` without the encoder."""
        return self.policy.rl_parameter_groups()
