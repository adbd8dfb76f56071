"""The simulated desk: one scene, the goal that its arm was given, and how time passes there."""

from math import ceil
from time import perf_counter

import numpy as np
from lerobot.utils.robot_utils import precise_sleep
from lerobot_env_cronos import CronosVectorEnv

MAX_CATCH_UP_S = 10.0
"""Most time that is simulated at once. After so long with one goal everything lies still: more changes nothing."""
ONLY = np.array([0])


class Desk:
    """One stream of a scene, and its clock.

    In real time the scene follows the wall clock in whole control steps, whenever somebody looks or acts.
    Otherwise each goal takes one control step.

    Attributes:
        world: the scene; read it to know the truth.
        goal: positions (6,) that the arm holds or goes to, in degrees; the gripper from 0 to 100.
        steps: control steps so far.
    """

    def __init__(self, scene: str, start: int, real_time: bool):
        self.world = CronosVectorEnv(1, scene, obs_type="environment_state_agent_pos", num_threads=1)
        self.real_time, self.steps = real_time, 0
        self._began = perf_counter()
        self.place(start)

    def place(self, start: int, split: str = "train") -> None:
        """Put all bodies at a start of a split, and the arm home."""
        self.catch_up()
        self.world.scene_reset(ONLY, np.array([start]), split)
        self.goal = self.world.scene.robot.hold(self.world.simulation.arm_target)[0]

    def positions(self) -> np.ndarray:
        """Where the arm is (6,), in the units of `goal`."""
        self.catch_up()
        return self.world.observe()["agent_pos"][0]

    def write_goal(self, goal: np.ndarray) -> None:
        """Let the arm go to `goal` (6,)."""
        self.catch_up()
        self.goal = goal
        if not self.real_time:
            self._advance(1)

    def catch_up(self) -> None:
        """Simulate the time that has passed on the wall clock."""
        if self.real_time:
            fps = self.world.fps
            behind = int((perf_counter() - self._began) * fps) - self.steps
            most = round(MAX_CATCH_UP_S * fps)
            self._began += max(behind - most, 0) / fps
            self._advance(min(behind, most))

    def _advance(self, steps: int) -> None:
        for _ in range(steps):
            self.world.step_streams(self.goal[None], ONLY)
        self.steps += steps

    # Clock ------------------------------------------------------------------------------------------------

    def time(self) -> float:
        """The wall clock's time, or the simulated one [s]."""
        return perf_counter() if self.real_time else self.steps / self.world.fps

    def sleep(self, seconds: float) -> None:
        """Wait. Simulated time passes in whole control steps, in which the arm keeps its goal."""
        if self.real_time:
            precise_sleep(seconds)
        else:
            self._advance(ceil(round(seconds * self.world.fps, 6)))
