"""`--teleop.type=cronos_person`: a scripted person beside the simulated arm."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.lerobot_types import RobotAction
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig
from lerobot.teleoperators.utils import TeleopEvents
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot.utils.errors import DeviceNotConnectedError
from lerobot_env_cronos import ScriptedExpert
from lerobot_env_cronos.scene.arms.so101.arm import SO101_ARM

from lerobot_robot_cronos.desk import ONLY
from lerobot_robot_cronos.so101 import CronosSO101, connected_robots

OTHER_EVENTS = ("scene_reset", "pause", "emergency_stop")
"""What `get_teleop_events` tells beside LeRobot's."""
WRONG_AT = 0.9
"""When the wrong key is pressed in a segment that has not succeeded: after this share of a task's time."""


@TeleoperatorConfig.register_subclass("cronos_person")
@dataclass(kw_only=True)
class CronosPersonConfig(TeleoperatorConfig):
    """A person who is quick or slow, right or wrong. All times are those of the robot's clock."""

    robot_id: str | None = None
    """`--robot.id` of the arm."""
    task: str | None = None
    """Instruction of the task to do from the beginning, for programs that send no feedback."""
    judges: bool = True
    """Press SUCCESS when the task has succeeded."""
    reaction_s: float = 1.0
    """Time from the success to the key [s]."""
    wrong_key_rate: float = 0.0
    """Share of segments judged wrongly: SUCCESS is pressed only if the task has not succeeded."""
    reset_s: float = 20.0
    """Time that it takes to put the scene to a start [s]."""
    late_rate: float = 0.0
    """Share of resets that take longer, by up to as long again."""
    patience_s: float = 8.0
    """Time in a segment without a success after which the person takes over [s]."""
    takeovers: int = 0
    """How often the person takes over, in all."""
    seed: int = 0


@dataclass
class _Segment:
    """What the person knows of the task under way."""

    began: float
    wrong: bool
    succeeded: float | None = None
    judged: bool = False
    helping: bool = False


class CronosPerson(Teleoperator):
    """Works as the scripted expert does, presses keys, and resets the scene when asked."""

    config_class = CronosPersonConfig
    name = "cronos_person"

    def __init__(self, config: CronosPersonConfig):
        super().__init__(config)
        self.config, self.judges = config, config.judges
        self._rng = np.random.default_rng(config.seed)
        self._is_connected = False
        self._told = config.task
        self._segment: _Segment | None = None
        self._reset: tuple[float, int, str] | None = None
        self._pressed: set[TeleopEvents | str] = set()
        self._takeovers_left = config.takeovers
        self._action: np.ndarray | None = None
        self._acted_at = -1

    @property
    def action_features(self) -> dict[str, type]:
        """The robot's."""
        return dict.fromkeys(SO101_ARM.action_names, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """What a program tells the person, see `send_feedback`."""
        return {"task": str, "scene_reset": int, "split": str, "judge": bool, "lost": str}

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Tell the person something.

        Args:
            feedback: some of `task`, the instruction of a segment that begins; `scene_reset`, the start that is
                wanted, of `split` ("train" if absent); `judge`, whether to press SUCCESS from now on; `lost`, what
                failed: every cable is plugged in, and that is reported as a reset is.
        """
        robot = self._look()
        self.judges = feedback.get("judge", self.judges)
        if "scene_reset" in feedback:
            takes = self.config.reset_s
            late, by = self._rng.random(2)
            takes *= 1 + by * (late < self.config.late_rate)
            split = feedback.get("split", "train")
            self._reset = (robot.clock.time() + takes, feedback["scene_reset"], split)
        if "lost" in feedback:
            for device in (robot.bus, *robot.cameras.values()):
                device.plug_in()
            self.press("scene_reset")
        if "task" in feedback:
            self._begin(robot, feedback["task"])

    def press(self, event: TeleopEvents | str) -> None:
        """Let the person press a key: one of LeRobot's events, "pause" or "emergency_stop"."""
        self._pressed.add(event)

    @check_if_not_connected
    def get_teleop_events(self) -> dict[Any, bool]:
        """LeRobot's events and `OTHER_EVENTS` since the last call; IS_INTERVENTION while the person acts."""
        robot = self._look()
        if self._segment is not None:
            self._judge(robot, self._segment)
            self._help(robot, self._segment)
        events = {event: event in self._pressed for event in (*TeleopEvents, *OTHER_EVENTS)}
        self._pressed.clear()
        events[TeleopEvents.IS_INTERVENTION] = self._segment is not None and self._segment.helping
        return events

    @check_if_not_connected
    def get_action(self) -> RobotAction:
        """What a leader arm would say: the expert's goals for the task, or without one the arm's goal."""
        robot = self._look()
        if self._segment is None:
            action = robot.desk.goal
        else:
            # Once a control step, however often it is asked: the expert counts steps.
            if self._action is None or self._acted_at != robot.desk.steps:
                self._action, self._acted_at = self._expert.act()[0], robot.desk.steps
            action = self._action
        return dict(zip(self.action_features, map(float, action)))

    def _look(self) -> CronosSO101:
        """Find the robot as it is now, and do what is due."""
        robot = connected_robots.get(self.config.robot_id)
        if robot is None:
            found = f"robots that are connected here: {list(connected_robots)}"
            raise DeviceNotConnectedError(f"no robot has the id {self.config.robot_id!r}; {found}")
        robot.desk.catch_up()
        if self._told is not None:
            self._begin(robot, self._told)
        if self._reset is not None and robot.clock.time() >= self._reset[0]:
            robot.place(*self._reset[1:])
            self._reset, self._action = None, None
            self.press("scene_reset")
        return robot

    def _begin(self, robot: CronosSO101, instruction: str) -> None:
        world = robot.world
        tasks = {task.instruction: task for task in (*world.tasks, *world.reset_tasks)}
        if instruction not in tasks:
            raise ValueError(f"unknown task {instruction!r}; tasks of {world.scene.name}: {list(tasks)}")
        world.set_task(ONLY, [tasks[instruction]])
        self._segment = _Segment(robot.clock.time(), self._rng.random() < self.config.wrong_key_rate)
        self._expert, self._action, self._told = ScriptedExpert(world), None, None

    def _judge(self, robot: CronosSO101, segment: _Segment) -> None:
        world, now = robot.world, robot.clock.time()
        if segment.succeeded is None and world.is_success[0]:
            segment.succeeded = now
        if segment.succeeded is None:
            presses = segment.wrong and now - segment.began >= WRONG_AT * world.steps_per_task / world.fps
        else:
            presses = not segment.wrong and now - segment.succeeded >= self.config.reaction_s
        if self.judges and presses and not segment.judged:
            segment.judged = True
            self.press(TeleopEvents.SUCCESS)

    def _help(self, robot: CronosSO101, segment: _Segment) -> None:
        """Take over when it takes too long, until the object lies where it should and is let go of."""
        if segment.helping:
            segment.helping = not robot.world.is_success[0] or bool(robot.world.is_grasped[0])
        elif (
            segment.succeeded is None
            and self._takeovers_left
            and robot.clock.time() - segment.began >= self.config.patience_s
        ):
            segment.helping = True
            self._takeovers_left -= 1
            self._expert.reset(ONLY)
            self._action = None

    # Connection -------------------------------------------------------------------------------------------

    @property
    def is_connected(self) -> bool:
        """See `Teleoperator`."""
        return self._is_connected

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """See `Teleoperator`; the robot may be connected later."""
        self._is_connected = True

    @check_if_not_connected
    def disconnect(self) -> None:
        """See `Teleoperator`."""
        self._is_connected = False

    @property
    def is_calibrated(self) -> bool:
        """There is nothing to calibrate."""
        return True

    def calibrate(self) -> None:
        """There is nothing to calibrate."""

    def configure(self) -> None:
        """There is nothing to configure."""
