"""`--robot.type=cronos_so101`: LeRobot's robot over an SO-101 scene."""

from dataclasses import dataclass, field

from lerobot.lerobot_types import RobotAction, RobotObservation
from lerobot.motors import MotorCalibration
from lerobot.robots import Robot, RobotConfig
from lerobot.robots.utils import ensure_safe_goal_position
from lerobot.utils.constants import HF_LEROBOT_CALIBRATION, ROBOTS
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected
from lerobot_env_cronos import CronosVectorEnv, get_scene
from lerobot_env_cronos.scene.arms.so101.arm import SO101_ARM
from lerobot_env_cronos.simulation.observations import environment_state_names

from lerobot_robot_cronos.bus import SimulatedBus
from lerobot_robot_cronos.camera import SimulatedCamera
from lerobot_robot_cronos.desk import Desk

TICKS = 4095
"""Of a motor, a turn [1]."""

connected_robots: dict[str | None, "CronosSO101"] = {}
"""Those of this process that are connected, by id: who stands beside one finds it here."""


@RobotConfig.register_subclass("cronos_so101")
@dataclass(kw_only=True)
class CronosSO101Config(RobotConfig):
    """A simulated SO-101 at its desk."""

    scene: str = "so101_desk_2x2"
    """`so101_desk_2x2`, `so101_desk_3x3` or a registered scene of this arm."""
    start: int = 0
    """Training start at which the scene begins."""
    real_time: bool = True
    """Follow the wall clock; if false, each goal takes one control step of 1/30 s and nothing else takes time."""
    camera_names: list[str] = field(default_factory=lambda: ["front", "wrist"])
    """Which cameras there are, of `front` and `wrist`; may be empty."""
    camera_height: int = 240
    camera_width: int = 320
    privileged_state: bool = False
    """Observe where the objects are, too, as with a motion-capture system: the numbers of the scene's
    `environment_state` by their names."""
    max_relative_target: float | dict[str, float] | None = None
    """Furthest that a goal may be from where the arm is, for all motors or by motor; see LeRobot's SO-101."""


class CronosSO101(Robot):
    """A simulated SO-101 with the features, units and type of LeRobot's `so101_follower`.

    Whoever connects it again finds the scene as it was left.

    Attributes:
        bus, cameras: as the real arm's; `unplug()` and `plug_in()` simulate lost cables.
        desk: the simulation.
    """

    config_class = CronosSO101Config
    name = SO101_ARM.robot_type

    def __init__(self, config: CronosSO101Config):
        if get_scene(config.scene).arm != SO101_ARM.name:
            raise ValueError(f"scene {config.scene!r} has another arm than the SO-101")
        if config.calibration_dir is None:
            # Not where a real arm of the same id has its own.
            config.calibration_dir = HF_LEROBOT_CALIBRATION / ROBOTS / config.type
        super().__init__(config)
        self.config = config
        self.desk = Desk(config.scene, config.start, config.real_time)
        self.bus = SimulatedBus(self.desk, self.calibration)
        size = config.camera_height, config.camera_width
        self.cameras = {name: SimulatedCamera(self.desk, name, *size) for name in config.camera_names}

    @property
    def world(self) -> CronosVectorEnv:
        """The scene, for judges and tests. Read it; do not step it."""
        return self.desk.world

    @property
    def clock(self) -> Desk:
        """With `time()` [s] and `sleep(seconds)`: the wall clock's, or simulated."""
        return self.desk

    def place(self, start: int, split: str = "train") -> None:
        """Somebody puts the bodies at a start of a split, and the arm home."""
        self.desk.place(start, split)

    @property
    def action_features(self) -> dict[str, type]:
        """See `Robot`."""
        return {f"{motor}.pos": float for motor in self.bus.motors}

    @property
    def observation_features(self) -> dict[str, type | tuple]:
        """See `Robot`."""
        cameras = {name: (camera.height, camera.width, 3) for name, camera in self.cameras.items()}
        return {**self.action_features, **dict.fromkeys(self._body_names, float), **cameras}

    @property
    def _body_names(self) -> tuple[str, ...]:
        return environment_state_names(self.world.scene) if self.config.privileged_state else ()

    @property
    def is_connected(self) -> bool:
        """See `Robot`."""
        return self.bus.is_connected and all(camera.is_connected for camera in self.cameras.values())

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """See `Robot`."""
        self.bus.connect()
        if calibrate and not self.is_calibrated:
            self.calibrate()
        for camera in self.cameras.values():
            camera.connect()
        self.configure()
        connected_robots[self.id] = self

    @property
    def is_calibrated(self) -> bool:
        """See `Robot`."""
        return self.bus.is_calibrated

    def calibrate(self) -> None:
        """Write LeRobot's calibration file to the motors, or the arm's ranges to both. Nobody is asked."""
        if not self.calibration:
            low, high = SO101_ARM.action_low, SO101_ARM.action_high
            for i, (name, motor) in enumerate(self.bus.motors.items()):
                ends = (round(TICKS * (0.5 + degrees / 360)) for degrees in (low[i], high[i]))
                self.calibration[name] = MotorCalibration(motor.id, 0, 0, *ends)
            self._save_calibration()
        self.bus.write_calibration(self.calibration)

    def configure(self) -> None:
        """Give the motors torque."""
        self.bus.enable_torque()

    @check_if_not_connected
    def get_observation(self) -> RobotObservation:
        """See `Robot`."""
        positions = {f"{motor}.pos": value for motor, value in self.bus.sync_read("Present_Position").items()}
        bodies = zip(self._body_names, self.world.observe()["environment_state"][0].tolist())
        pictures = {name: camera.read_latest() for name, camera in self.cameras.items()}
        return {**positions, **dict(bodies), **pictures}

    @check_if_not_connected
    def send_action(self, action: RobotAction) -> RobotAction:
        """See `Robot`; the goals that were sent come back, limited by `max_relative_target`."""
        goal = {key.removesuffix(".pos"): float(value) for key, value in action.items() if key.endswith(".pos")}
        if self.config.max_relative_target is not None:
            present = self.bus.sync_read("Present_Position")
            both = {motor: (value, present[motor]) for motor, value in goal.items()}
            goal = ensure_safe_goal_position(both, self.config.max_relative_target)
        self.bus.sync_write("Goal_Position", goal)
        return {f"{motor}.pos": value for motor, value in goal.items()}

    @check_if_not_connected
    def disconnect(self) -> None:
        """See `Robot`."""
        self.bus.disconnect()
        for camera in self.cameras.values():
            camera.disconnect()
        # Another one may have been connected under its id.
        if connected_robots.get(self.id) is self:
            del connected_robots[self.id]
