"""The box of physical actions that the normalised range [-1, 1] stands for."""

from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import EnvTransition, ProcessorStep, ProcessorStepRegistry, TransitionKey
from lerobot.utils.constants import OBS_STATE, OBS_STR
from torch import Tensor

JOINTS = f"{OBS_STR}.joints"
"""Key of where the joints are that the actions move, (B, D), in the actions' normalised units."""

ActionBounds = tuple[tuple[float, ...], tuple[float, ...]]
"""(low, high), each with one entry per action dimension, in the action's physical units."""

BRIDGE_ORIG_BOUNDS: ActionBounds = (
    (
        -0.02872725307941437,
        -0.04170349963009357,
        -0.026093858778476715,
        -0.08092105075716972,
        -0.09288699507713317,
        -0.20718276381492615,
        0.0,
    ),
    (
        0.028309678435325586,
        0.040855254605412394,
        0.040161586627364146,
        0.08192047759890528,
        0.07792850524187081,
        0.20382574498653397,
        1.0,
    ),
)
"""OpenVLA's `bridge_orig` statistics: the 1st and 99th percentile of BridgeData V2's actions
[dx, dy, dz (m), droll, dpitch, dyaw (rad)] per control step, and the gripper command, 0 closed to 1 open."""


@dataclass
@ProcessorStepRegistry.register(name="pocketvla_action_bounds")
class ActionBoundsProcessorStep(ProcessorStep):
    """Maps actions between the physical box [low, high] and [-1, 1], dimension by dimension.

    This is a step of its own, not statistics of LeRobot's normaliser, because `lerobot-train --policy.path`
    replaces a normaliser's statistics by those of the new dataset: the policy's bins would silently come
    to mean other actions. The bounds are part of the step's saved JSON.

    Raises:
        ValueError: a low is not below its high.
    """

    low: list[float] = field(default_factory=list)
    """Physical action that -1 stands for, one entry per dimension."""
    high: list[float] = field(default_factory=list)
    """Physical action that +1 stands for, one entry per dimension."""
    inverse: bool = False
    """False: physical to normalised (preprocessor). True: normalised to physical (postprocessor)."""
    joints: list[int] = field(default_factory=list)
    """Where `observation.state`, as it comes, has the joint that each dimension moves, -1 if nowhere; empty if the
    policy does not ask."""

    def __post_init__(self) -> None:
        """Check the bounds at once."""
        for dim, (low, high) in enumerate(zip(self.low, self.high, strict=True)):
            if not low < high:
                raise ValueError(f"action dimension {dim}: low {low} must be below high {high}")

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Convert the transition's action, if it has one, and add the joints to its observation, if asked."""
        action, observation = transition.get(TransitionKey.ACTION), transition.get(TransitionKey.OBSERVATION)
        converted = transition.copy()
        if action is not None:
            converted["action"] = self.convert(torch.as_tensor(action))
        if self.joints and observation:
            state = torch.as_tensor(observation[OBS_STATE])
            where = torch.tensor(self.joints, device=state.device)
            # At 0, the middle of the box, where there is none: its actions stay as they are.
            joints = self.convert(state[..., where]) * (where >= 0)
            converted["observation"] = dict(observation) | {JOINTS: joints}
        return converted

    def convert(self, action: Tensor) -> Tensor:
        """Convert actions of shape (..., len(low)) in the direction that `inverse` tells.

        What is beyond [-1, 1], as a chain of noise may end, becomes an end of the box.
        """
        low = torch.as_tensor(self.low, dtype=torch.float32, device=action.device)
        high = torch.as_tensor(self.high, dtype=torch.float32, device=action.device)
        if self.inverse:
            return low + (action.float().clamp(-1.0, 1.0) + 1.0) * 0.5 * (high - low)
        return 2.0 * (action.float() - low) / (high - low) - 1.0

    def get_config(self) -> dict[str, Any]:
        """Return what is written to the processor's JSON."""
        return {"low": self.low, "high": self.high, "inverse": self.inverse, "joints": self.joints}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Shapes and types stay as they are."""
        return features
