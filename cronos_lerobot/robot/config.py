"""`--env.type=cronos_robot`: a LeRobot robot as the world of a run."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from lerobot.cameras import opencv, realsense  # noqa: F401  (registers them)
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.robots import (  # noqa: F401
    RobotConfig,
    koch_follower,
    make_robot_from_config,
    omx_follower,
    so_follower,
)
from lerobot.teleoperators import (  # noqa: F401
    TeleoperatorConfig,
    gamepad,
    koch_leader,
    make_teleoperator_from_config,
    omx_leader,
    so_leader,
)
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE
from lerobot_env_cronos.simulation.observations import TASK_OBSERVATIONS

from cronos_lerobot.ranges import check_ranges, ranged
from cronos_lerobot.robot.judges import PERSON, SIM, Judge, PersonJudge, SimJudge
from cronos_lerobot.robot.reward_models import RewardModelJudge
from cronos_lerobot.robot.setups import Setup, load_setup
from cronos_lerobot.robot.station import Station
from cronos_lerobot.robot.streams import RobotStreams

JUDGES = (PERSON, SIM)


@EnvConfig.register_subclass("cronos_robot")
@dataclass
class CronosRobotConfig(EnvConfig):
    """Practice on one robot, simulated or real, with a person beside it."""

    fps: int = ranged(30, minimum=1)
    """Control steps a second [Hz]."""
    robot: RobotConfig | None = None
    """LeRobot's robot: --env.robot.type=so101_follower --env.robot.port=... --env.robot.id=..."""
    teleop: TeleoperatorConfig | None = None
    """LeRobot's leader arm, to take over, or gamepad, whose buttons judge: --env.teleop.type=so101_leader ..."""
    tasks: str = "so101_desk_2x2"
    """A file with tasks, pictures of the starts, home pose and limits; or a scene, built as its sheets say."""
    task_observation: str = ranged("none", choices=TASK_OBSERVATIONS)
    """one_hot appends the task to the robot's state, for policies that read no instructions, such as ACT."""
    steps_per_task: int = ranged(480, minimum=1)
    """Control steps that a task has."""
    judge: str = "person"
    """Who says that a task is done: person (keys or buttons), sim (the truth of a simulated robot), or a folder
    with LeRobot's reward classifiers, a sub-folder for each task: put_the_cube_on_the_plate."""
    judge_error: float | None = ranged(None, minimum=0, maximum=1)
    """Share of the segments in which the judge is wrong; null if nobody knows. `sim` is wrong as often; of others
    it is noted."""
    judge_seed: int = ranged(0, minimum=0)
    """Of the errors of `sim`."""
    max_step: float | None = ranged(None, above=0)
    """The furthest that a target moves in one control step [degrees, or percent of the gripper]; null for any."""
    dry_run: bool = False
    """Everything but motion: shows pictures, targets, limits and keys."""
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_ranges(self, "env.")
        if self.robot is None:
            raise ValueError("--env.type=cronos_robot needs a robot: --env.robot.type=so101_follower ...")
        station, told = self.station, len(self._told)
        self.features = {ACTION: PolicyFeature(FeatureType.ACTION, (len(station.action_names),))}
        self.features_map = {ACTION: ACTION}
        for name, (kind, key), size in (
            ("agent_pos", (FeatureType.STATE, OBS_STATE), len(station.state_names) + told),
            ("environment_state", (FeatureType.ENV, OBS_ENV_STATE), len(station.other_names)),
        ):
            if size:
                self.features[name] = PolicyFeature(kind, (size,))
                self.features_map[name] = key
        for camera, shape in station.cameras.items():
            key = f"{OBS_IMAGES}.{camera}"
            self.features[key] = PolicyFeature(FeatureType.VISUAL, shape)
            self.features_map[key] = key

    # Of Gymnasium's environments, and this is none.
    gym_kwargs = None

    @cached_property
    def setup(self) -> Setup:
        """What stands around the robot."""
        return load_setup(self.tasks)

    @cached_property
    def station(self) -> Station:
        """The robot, which training and evaluation share."""
        assert self.robot is not None
        robot = make_robot_from_config(self.robot)
        teleop = None if self.teleop is None else make_teleoperator_from_config(self.teleop)
        return Station(robot, teleop, self.setup, self.fps, self.max_step, self.dry_run)

    @property
    def _told(self) -> tuple[str, ...]:
        return self.setup.task_names if self.task_observation == "one_hot" else ()

    def create_streams(self, num_envs: int) -> RobotStreams:
        """The robot as one stream.

        Raises:
            ValueError: several were asked for.
        """
        if num_envs != 1:
            raise ValueError(f"a robot is there once: --num_envs=1, got {num_envs}")
        return self._streams("training")

    def create_eval_streams(self, num_envs: int) -> RobotStreams:
        """The same robot; however many are asked for, it is one."""
        return self._streams("evaluation")

    def _streams(self, purpose: str) -> RobotStreams:
        judge = self._judge()
        error = "" if self.judge_error is None else f", wrong in {self.judge_error:.1%} of the segments"
        return RobotStreams(self.station, judge, f"judge {judge.name}{error}", purpose, self._told)

    def _judge(self) -> Judge:
        if self.judge == PERSON:
            return PersonJudge()
        if self.judge != SIM:
            if not Path(self.judge).is_dir():
                raise ValueError(f"--env.judge must be one of {JUDGES} or a folder, got {self.judge!r}")
            return RewardModelJudge(
                Path(self.judge), self.setup.tasks, self.setup.reset_tasks, self.station.cameras
            )
        if (world := getattr(self.station.robot, "world", None)) is None:
            raise ValueError(f"--env.judge=sim needs a simulated robot, got {self.station.robot}")
        rng = np.random.default_rng(self.judge_seed)
        return SimJudge(world, self.judge_error or 0.0, self.steps_per_task, rng)
