"""The motors' bus of the simulated arm, as LeRobot's code reads and writes it."""

from lerobot.motors import Motor, MotorCalibration, MotorNormMode
from lerobot.motors.motors_bus import MotorsBusBase, Value
from lerobot.utils.decorators import check_if_not_connected

from lerobot_robot_cronos.cable import Cable
from lerobot_robot_cronos.desk import Desk

REGISTERS = ("Present_Position", "Goal_Position", "Torque_Enable")


class SimulatedBus(Cable, MotorsBusBase):
    """Six motors in LeRobot's units of a calibrated arm: degrees; the gripper from 0 to 100.

    A motor without torque holds its position and ignores goals. It does not go limp.
    The calibration is kept, written and compared, but the units do not depend on it.
    An unplugged bus raises a ConnectionError at each access.
    """

    def __init__(self, desk: Desk, calibration: dict[str, MotorCalibration]):
        names = [name.removesuffix(".pos") for name in desk.world.action_names]
        modes = [MotorNormMode.DEGREES] * (len(names) - 1) + [MotorNormMode.RANGE_0_100]
        motors = {name: Motor(i, "sts3215", mode) for i, (name, mode) in enumerate(zip(names, modes), 1)}
        super().__init__(desk.world.scene.name, motors, calibration)
        self._desk = desk
        self._torque = dict.fromkeys(names, True)
        self._written: dict[str, MotorCalibration] = {}

    def connect(self, handshake: bool = True) -> None:
        """See `MotorsBusBase`."""
        self._open()

    @check_if_not_connected
    def disconnect(self, disable_torque: bool = True) -> None:
        """See `MotorsBusBase`. As LeRobot's, a lost bus closes only with `disable_torque=False`."""
        if disable_torque:
            self.disable_torque()
        self._close()

    def read(self, data_name: str, motor: str, *, num_retry: int = 0) -> Value:
        """The value of one motor's register, one of `REGISTERS`."""
        return self.sync_read(data_name, motor)[motor]

    def write(self, data_name: str, motor: str, value: Value, *, num_retry: int = 0) -> None:
        """Set `Goal_Position` or `Torque_Enable` of one motor."""
        self.sync_write(data_name, {motor: value})

    @check_if_not_connected
    def sync_read(
        self, data_name: str, motors: str | list[str] | None = None, *, num_retry: int = 0
    ) -> dict[str, Value]:
        """The values of one of `REGISTERS`, by motor."""
        self._check_answers(data_name)
        if data_name == "Torque_Enable":
            values = {name: int(on) for name, on in self._torque.items()}
        else:
            numbers = self._desk.positions() if data_name == "Present_Position" else self._desk.goal
            values = dict(zip(self.motors, map(float, numbers)))
        return {name: values[name] for name in self._names(motors)}

    @check_if_not_connected
    def sync_write(self, data_name: str, values: dict[str, Value], *, num_retry: int = 0) -> None:
        """Set `Goal_Position` or `Torque_Enable` of some motors."""
        self._check_answers(data_name)
        if data_name == "Present_Position":
            raise KeyError("Present_Position can only be read")
        if data_name == "Torque_Enable":
            self._torque |= {name: bool(value) for name, value in values.items()}
            return
        goal = self._desk.goal.copy()
        for i, name in enumerate(self.motors):
            if name in values and self._torque[name]:
                goal[i] = float(values[name])
        self._desk.write_goal(goal)

    def enable_torque(self, motors: str | list[str] | None = None, num_retry: int = 0) -> None:
        """See `MotorsBusBase`."""
        self.sync_write("Torque_Enable", dict.fromkeys(self._names(motors), 1))

    def disable_torque(self, motors: str | list[str] | None = None, num_retry: int = 0) -> None:
        """See `MotorsBusBase`; the motors hold still."""
        self.sync_write("Torque_Enable", dict.fromkeys(self._names(motors), 0))

    @property
    def is_calibrated(self) -> bool:
        """Whether the motors have the calibration of LeRobot's file."""
        return bool(self.calibration) and self.read_calibration() == self.calibration

    def read_calibration(self) -> dict[str, MotorCalibration]:
        """What was written to the motors; nothing in a new simulation."""
        return self._written.copy()

    def write_calibration(self, calibration_dict: dict[str, MotorCalibration], cache: bool = True) -> None:
        """See `MotorsBusBase`."""
        self._written = calibration_dict.copy()
        if cache:
            self.calibration = calibration_dict

    def _names(self, motors: str | list[str] | None) -> list[str]:
        return [motors] if isinstance(motors, str) else motors or list(self.motors)

    def _check_answers(self, data_name: str) -> None:
        if self._lost:
            raise ConnectionError(f"Failed to access {data_name!r}: there is no status packet")
        if data_name not in REGISTERS:
            raise KeyError(f"unknown register {data_name!r}; simulated are {list(REGISTERS)}")
