"""What is done to the expert on purpose: noise, missed grasps, unusual arm poses.

Only the EXECUTED action is perturbed. The recorded action stays the expert's own for the state that it finds
itself in, so the data show how to come back from states the expert alone would never visit (Laskey et al.
2017, "DART: Noise Injection for Robust Imitation Learning").
"""

from dataclasses import dataclass

import numpy as np
from lerobot_env_cronos import CronosVectorEnv, ScriptedExpert
from lerobot_env_cronos.scene.arms.arm import Arm
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX
from lerobot_env_cronos.scene.arms.widowx.kinematics import inverse_kinematics

from cronos_lerobot.ranges import ranged


@dataclass
class NoiseConfig:
    """Bursts of noise on the executed action; within a burst the arm is pushed one constant way."""

    share: float = ranged(0.0, minimum=0, maximum=1)
    """Share of the episodes that have bursts, from 0 to 1."""
    rate: float = ranged(0.15, minimum=0, maximum=1)
    """Probability per 0.2 s, a control step of the WidowX, that a burst begins."""
    min_steps: int = ranged(1, minimum=1)
    """Shortest burst [0.2 s]."""
    max_steps: int = 4
    """Longest burst [0.2 s]."""
    scale: float = ranged(0.6, minimum=0)
    """Standard deviation of the push: of half the range of the WidowX's actions, of 6 degrees in 0.2 s of the
    SO-101's."""

    def __post_init__(self) -> None:
        """Check what goes with what."""
        if self.min_steps > self.max_steps:
            raise ValueError(f"--noise.min_steps must be at most --noise.max_steps: {self}")


@dataclass
class MissConfig:
    """Deliberately missed grasps: the gripper first closes beside the object, then the expert recovers."""

    share: float = ranged(0.0, minimum=0, maximum=1)
    """Share of the episodes that begin with a miss, from 0 to 1."""
    min_offset_m: float = ranged(0.025, above=0)
    """Smallest horizontal distance between the object and where the gripper closes [m]."""
    max_offset_m: float = 0.06
    """Largest such distance [m]."""

    def __post_init__(self) -> None:
        """Check what goes with what."""
        if self.min_offset_m > self.max_offset_m:
            raise ValueError(f"--misses.min_offset_m must be at most --misses.max_offset_m: {self}")


class ActionNoise:
    """The bursts of every stream."""

    def __init__(self, config: NoiseConfig, num_envs: int, arm: Arm) -> None:
        """No bursts until `reset`."""
        self._config, self._arm = config, arm
        self._rngs: list[np.random.Generator | None] = [None] * num_envs
        self._remaining = np.zeros(num_envs, dtype=np.int64)
        self._push = np.zeros((num_envs, len(arm.push)))

    def reset(self, stream: int, rng: np.random.Generator) -> None:
        """A new episode begins in `stream`; `rng` decides whether it has bursts, and draws them."""
        self._rngs[stream] = rng if rng.random() < self._config.share else None
        self._remaining[stream] = 0

    def apply(self, actions: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Add the noise of this step to actions (n, a) of the `active` (n,) streams; returns a copy.

        The gripper's command, the last number, is never perturbed.
        """
        actions, config, arm = actions.copy(), self._config, self._arm
        for stream in np.flatnonzero(active):
            rng = self._rngs[stream]
            if rng is None:
                continue
            if self._remaining[stream] == 0 and rng.random() < config.rate / arm.steps_per_reading:
                length = rng.integers(config.min_steps, config.max_steps, endpoint=True)
                self._remaining[stream] = length * arm.steps_per_reading
                self._push[stream] = rng.normal(size=len(arm.push)) * config.scale * arm.push
            if self._remaining[stream] > 0:
                self._remaining[stream] -= 1
                actions[stream, :-1] += self._push[stream]
        return np.clip(actions, arm.action_low, arm.action_high).astype(np.float32)


class GraspMisses:
    """Steers the WidowX's gripper beside the object, closes it there, and hands the arm back to the expert."""

    HOVER_M = 0.06
    """Height above the object at which the approach ends and the descent begins [m]."""
    TOLERANCE_M = 0.008
    """A waypoint counts as reached within this distance [m]."""
    CLOSED_STEPS = 3
    MAX_STEPS = 25
    """A miss that takes longer (the object was knocked away, the place is out of reach) is given up."""

    def __init__(self, config: MissConfig, env: CronosVectorEnv) -> None:
        """No misses until `reset`."""
        self._config, self._env = config, env
        self._offset: list[np.ndarray | None] = [None] * env.num_envs
        self._descending = np.zeros(env.num_envs, dtype=bool)
        self._closed_steps = np.zeros(env.num_envs, dtype=np.int64)
        self._steps = np.zeros(env.num_envs, dtype=np.int64)

    def reset(self, stream: int, rng: np.random.Generator) -> None:
        """A new episode begins in `stream`; `rng` decides whether and where it misses first."""
        self._offset[stream] = None
        self._descending[stream] = False
        self._closed_steps[stream] = self._steps[stream] = 0
        if rng.random() < self._config.share:
            self._offset[stream] = _draw_offset(self._config, rng)

    def apply(self, actions: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Replace translation and gripper of actions (n, 7) in the `active` streams that are missing.

        The rotation stays the expert's: the gripper turns as for the real grasp.
        """
        missing = [i for i in np.flatnonzero(active) if self._offset[i] is not None]
        if not missing:
            return actions
        actions = actions.copy()
        targets = self._env.simulation.target_position()
        for stream in missing:
            actions[stream, :3], actions[stream, 6] = self._steer(stream, targets[stream])
            self._steps[stream] += 1
            if self._closed_steps[stream] == self.CLOSED_STEPS or self._steps[stream] == self.MAX_STEPS:
                self._offset[stream] = None
        return actions

    def _steer(self, stream: int, position: np.ndarray) -> tuple[np.ndarray, float]:
        """Translation [m] and gripper command of one stream that is missing."""
        body = self._env.simulation.body_pose(self._env.current_tasks[stream].object)[stream, :3]
        grasp = body + self._offset[stream]
        hover = grasp + np.array([0.0, 0.0, self.HOVER_M])
        if not self._descending[stream]:
            self._descending[stream] = np.linalg.norm(hover - position) < self.TOLERANCE_M
        goal = grasp if self._descending[stream] else hover
        # Above the table the target's height is clamped, so that only the horizontal distance can vanish.
        arrived = np.linalg.norm((grasp - position)[:2]) < self.TOLERANCE_M
        low = position[2] - grasp[2] < self.TOLERANCE_M + MIN_TARGET_HEIGHT_M
        if self._descending[stream] and arrived and low:
            self._closed_steps[stream] += 1
            return np.zeros(3), 0.0
        return np.clip(goal - position, WIDOWX.action_low[:3], WIDOWX.action_high[:3]), 1.0


class MistakenGrasps:
    """Misses of any arm: an expert that believes the object elsewhere acts until the hand has closed there.

    The misses of the WidowX's official bases are those of `GraspMisses`.
    """

    CLOSED_S, MAX_S = 0.6, 6.0
    """Time for which the hand closes, and time after which a miss is given up [s]."""

    def __init__(self, config: MissConfig, env: CronosVectorEnv) -> None:
        """No misses until `reset`."""
        self._config, self._expert = config, ScriptedExpert(env)
        self._max_closed, self._max_steps = round(self.CLOSED_S * env.fps), round(self.MAX_S * env.fps)
        self._is_missing = np.zeros(env.num_envs, dtype=bool)
        self._closed, self._steps = (np.zeros(env.num_envs, dtype=np.int64) for _ in range(2))

    def reset(self, stream: int, rng: np.random.Generator) -> None:
        """A new episode begins in `stream`; `rng` decides whether and where it misses first."""
        self._expert.reset(np.array([stream]))
        self._closed[stream] = self._steps[stream] = 0
        self._is_missing[stream] = rng.random() < self._config.share
        self._expert.mistake[stream] = _draw_offset(self._config, rng)

    def apply(self, actions: np.ndarray, active: np.ndarray) -> np.ndarray:
        """Replace actions (n, a) in the `active` streams that are missing."""
        missing = self._is_missing & active
        if not missing.any():
            return actions
        mistaken = self._expert.act().astype(np.float32)
        self._steps += missing
        # The last number is the gripper's, and 0 closes it.
        self._closed += missing & (mistaken[:, -1] == 0)
        self._is_missing &= (self._closed < self._max_closed) & (self._steps < self._max_steps)
        return np.where(missing[:, None], mistaken, actions)


def _draw_offset(config: MissConfig, rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    distance = rng.uniform(config.min_offset_m, config.max_offset_m)
    return distance * np.array([np.cos(angle), np.sin(angle), 0.0])


MIN_TARGET_HEIGHT_M = 0.032
"""The environment keeps the end effector's target about this far above the table: its fingers' reach [m]."""


def move_arm_at_random(env: CronosVectorEnv, stream: int, rng: np.random.Generator) -> None:
    """Put the WidowX of a stream at a random place well above the table, the hand turned a little."""
    sim, ids = env.simulation, np.array([stream])
    position, rotation = sim.end_effector()
    position = np.array([[*rng.uniform((0.20, -0.18), (0.42, 0.18)), rng.uniform(0.12, 0.26)]])
    angle = rng.uniform(-0.6, 0.6)
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ rotation[ids]
    # The solver converges from where the arm is; a few rounds cover the widest moves.
    sim.move_arm(ids, inverse_kinematics(sim.qpos[ids, :6], position, turned, iterations=40))
