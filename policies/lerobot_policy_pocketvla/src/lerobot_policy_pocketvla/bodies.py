"""The bodies of a scene, as the policy reads them from the privileged state."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import EnvTransition, ProcessorStep, ProcessorStepRegistry, TransitionKey
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

BODY_PARTS = (
    *"xyz",
    *(f"r{row}{column}" for column in (1, 2) for row in (1, 2, 3)),
    *(f"from_ee.{axis}" for axis in "xyz"),
)
"""What the privileged state says of a body: position [m], two columns of its rotation matrix, position from the
hand [m]."""
BODY_WIDTH = len(BODY_PARTS) + 2
"""Numbers for each body after `BodiesProcessorStep`."""
POSITION, ROTATION, FROM_HAND, DOUBLED_YAW = slice(0, 3), slice(3, 9), slice(9, 12), slice(12, 14)
"""Where they are among them."""
POSITION_UNIT_M = 0.1
"""Length that 1 stands for in what the policy reads."""


def bodies_named(names: Sequence[str] | None) -> list[str]:
    """The bodies that a privileged state with these names consists of; none if it is of another kind."""
    names = list(names or [])
    bodies = [name.removesuffix(".x") for name in names[:: len(BODY_PARTS)]]
    return bodies if names == [f"{body}.{part}" for body in bodies for part in BODY_PARTS] else []


def describe_bodies(state: Tensor) -> Tensor:
    """Privileged states (..., 12 bodies) as the policy reads them, (..., 14 bodies).

    Lengths are in units of 0.1 m: units of the data's own deviations would blow up what hardly moved in it. Two
    numbers are added for each body, the cosine and sine of twice its yaw: a gripper holds a body alike when it has
    turned by half a turn.
    """
    parts = state.unflatten(-1, (-1, len(BODY_PARTS)))
    rotation = parts[..., ROTATION]
    return torch.cat(
        (
            parts[..., POSITION] / POSITION_UNIT_M,
            rotation,
            parts[..., FROM_HAND] / POSITION_UNIT_M,
            _doubled_yaw(rotation),
        ),
        dim=-1,
    ).flatten(-2)


def _doubled_yaw(rotation: Tensor) -> Tensor:
    """Cosine and sine of twice the yaw (..., 2) of rotations (..., 6), their first two columns."""
    x, y = rotation[..., 0], rotation[..., 1]
    # A body that stands on end has no yaw: both are 0.
    level = (x.square() + y.square()).clamp(min=1e-3)
    return torch.stack(((x.square() - y.square()) / level, 2 * x * y / level), dim=-1)


@dataclass
@ProcessorStepRegistry.register(name="pocketvla_bodies")
class BodiesProcessorStep(ProcessorStep):
    """Puts `describe_bodies` of `observation.environment_state` in its place, where there is one."""

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Convert the transition's privileged state."""
        observation: Mapping[str, Any] | None = transition.get(TransitionKey.OBSERVATION)
        if not observation or OBS_ENV_STATE not in observation:
            return transition
        converted = transition.copy()
        described = describe_bodies(observation[OBS_ENV_STATE].float())
        converted["observation"] = dict(observation) | {OBS_ENV_STATE: described}
        return converted

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """The feature stays what the environment gives."""
        return features
