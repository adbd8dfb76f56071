"""What the arm does when something goes wrong: prints a table of faults on the simulated SO-101.

    python benchmarks/robot_faults.py

Each row begins with the arm at home and a policy that swings it by 20 degrees. `after` is how far a joint target
moved [degrees] from the fault on, until a person acted; `home` is how far the arm is from home at the end.
"""

import signal
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from lerobot.teleoperators.utils import TeleopEvents
from lerobot_robot_cronos import CronosPersonConfig, CronosSO101Config

from cronos_lerobot.robot.config import CronosRobotConfig
from cronos_lerobot.robot.station import Stopped
from cronos_lerobot.robot.streams import RobotStreams

ONE, BEFORE, AFTER = np.array([0]), 45, 45


def swing(env: RobotStreams, step: int) -> np.ndarray:
    """An action (1, 6) of a policy that swings all joints."""
    home = env.station.setup.home
    return (home + 20 * np.sin(step / 15) * (np.arange(len(home)) < len(home) - 1))[None]


def lose_bus(env: RobotStreams) -> None:
    """The bus's cable comes off."""
    env.station.robot.bus.unplug()


def lose_camera(env: RobotStreams) -> None:
    """A camera's cable comes off."""
    env.station.robot.cameras["wrist"].unplug()


def emergency(env: RobotStreams) -> None:
    """The person presses the emergency stop."""
    env.station.person.teleop.press("emergency_stop")


def ctrl_c(env: RobotStreams) -> None:
    """Ctrl-C."""
    signal.raise_signal(signal.SIGINT)


def long_update(env: RobotStreams) -> None:
    """An update of 20 s, longer than a segment."""
    env.station.clock.sleep(20.0)
    env.station.begin()


def late_reset(env: RobotStreams) -> None:
    """A person takes two minutes to put the scene to a start."""
    env.station.person.teleop.config.reset_s = 120.0
    env.scene_reset(ONE, ONE)


def wrong_key(env: RobotStreams) -> None:
    """The person presses the key of a success that was none."""
    env.station.person.teleop.press(TeleopEvents.SUCCESS)


def far_action(env: RobotStreams) -> None:
    """The policy wants 1,000 degrees of every joint."""
    env.far = True


FAULTS: dict[str, Callable[[RobotStreams], None]] = {
    "bus lost": lose_bus,
    "camera lost": lose_camera,
    "emergency stop": emergency,
    "Ctrl-C": ctrl_c,
    "update of 20 s": long_update,
    "reset of 120 s": late_reset,
    "wrong key: success": wrong_key,
    "action of 1,000 degrees, max_step 10": far_action,
}


def begin(folder: Path, judge: str = "sim") -> RobotStreams:
    """The arm at home, a task begun."""
    env = CronosRobotConfig(
        robot=CronosSO101Config(id="desk", real_time=False, camera_names=["wrist"]),
        teleop=CronosPersonConfig(robot_id="desk", reset_s=2.0, judges=False),
        judge=judge,
        max_step=10.0,
    ).create_streams(1)
    env.folder, env.far = folder, False
    env.scene_reset(ONE, ONE)
    env.set_task(ONE, env.tasks[:1])
    return env


def play(name: str, folder: Path) -> dict:
    """Let a fault happen, and say what followed."""
    env = begin(folder / name, "person" if FAULTS[name] is wrong_key else "sim")
    robot, station = env.station.robot, env.station
    for step in range(BEFORE):
        env.step(swing(env, step))
    before, goals, diverged, stopped = robot.desk.goal.copy(), [], 0, ""
    try:
        FAULTS[name](env)
        for step in range(BEFORE, BEFORE + AFTER):
            action = np.full((1, 6), 1000.0) if env.far else swing(env, step)
            info = env.step(action)[4]
            goals.append(robot.desk.goal.copy())
            if info["is_success"][0]:
                stopped = "counted as success"
            if info["diverged"][0]:
                diverged = step - BEFORE + 1
                break
    except Stopped as signal_name:
        stopped = f"stopped by {signal_name}"
        goals.append(robot.desk.goal.copy())
    after = np.abs(np.array(goals)[:, :5] - before[:5]).max()
    largest = np.abs(np.diff([before, *goals], axis=0)).max()
    torque = all(robot.bus._torque.values())
    station._signal = None
    if diverged:
        env.scene_reset(ONE, ONE)
        stopped = "cut, went on after the person's reset"
    away = np.abs(robot.desk.positions() - station.setup.home)[:5].max()
    row = {
        "fault": name, "after [deg]": round(float(after), 1), "largest step [deg]": round(float(largest), 1),
        "torque": "on" if torque else "off", "end": stopped or "went on", "home [deg]": round(float(away), 1),
        "ledger": ", ".join(pd.read_json(env.folder / "interventions.jsonl", lines=True)["kind"]),
    }  # fmt: skip
    env.close()
    return row


def main() -> None:
    """Print the table."""
    signal.signal(signal.SIGINT, lambda number, frame: None)
    with tempfile.TemporaryDirectory() as folder:
        rows = [play(name, Path(folder)) for name in FAULTS]
    print(pd.DataFrame(rows).to_markdown(index=False))


if __name__ == "__main__":
    main()
