"""The simulated SO-101: the real arm's features, the scene's physics, the wall clock, lost cables."""

from types import SimpleNamespace

import numpy as np
import pytest
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError
from lerobot_env_cronos import CronosVectorEnv
from lerobot_robot_cronos import connected_robots
from simulated_arm import CAMERAS, SCENE, make_robot

ONE = np.arange(1)


def make_env(start: int) -> CronosVectorEnv:
    sizes = {"observation_height": 48, "observation_width": 64}
    env = CronosVectorEnv(1, SCENE, camera_name="front,wrist", num_threads=1, **sizes)
    env.scene_reset(ONE, np.array([start]))
    return env


def wander(env: CronosVectorEnv, steps: int) -> np.ndarray:
    """Actions (steps, 6) around home."""
    far = np.random.default_rng(0).normal(0, 4, (steps, 6)).cumsum(0)
    return (env.observe()["agent_pos"] + far).astype(np.float32)


def as_action(env: CronosVectorEnv, goal: np.ndarray) -> dict:
    return dict(zip(env.action_names, goal, strict=True))


def test_features_names_and_motors_are_the_real_arms(real_arm, tmp_path):
    robot = make_robot(tmp_path, **CAMERAS)
    assert list(robot.observation_features.items()) == list(real_arm.observation_features.items())
    assert list(robot.action_features.items()) == list(real_arm.action_features.items())
    assert (robot.name, robot.robot_type) == (real_arm.name, real_arm.robot_type)
    assert robot.bus.motors == real_arm.bus.motors
    with pytest.raises(ValueError, match="kitchen_2x2"):
        make_robot(tmp_path, scene="kitchen_2x2")


def test_it_does_what_the_scene_does_bit_for_bit(tmp_path):
    env, robot = make_env(3), make_robot(tmp_path, start=3, **CAMERAS)
    robot.connect()
    assert connected_robots["desk"] is robot
    for step, goal in enumerate(wander(env, 40)):
        seen = env.step(goal[None])[0]
        sent = robot.send_action(as_action(env, goal))
        assert list(sent.values()) == goal.tolist()
        if step % 13 == 0:
            found = robot.get_observation()
            np.testing.assert_array_equal([found[name] for name in env.state_names], seen["agent_pos"][0])
            for name, picture in seen["pixels"].items():
                np.testing.assert_array_equal(found[name], picture[0])
    np.testing.assert_array_equal(robot.world.simulation.qpos, env.simulation.qpos)
    robot.place(7, "held_out")
    env.scene_reset(ONE, np.array([7]), "held_out")
    np.testing.assert_array_equal(robot.world.simulation.qpos, env.simulation.qpos)
    assert robot.clock.time() == pytest.approx(40 / 30)
    robot.disconnect()
    assert "desk" not in connected_robots


def test_real_time_catches_up_with_the_last_goal(tmp_path, monkeypatch):
    wall = SimpleNamespace(now=100.0)
    monkeypatch.setattr("lerobot_robot_cronos.desk.perf_counter", lambda: wall.now)
    env, robot = make_env(0), make_robot(tmp_path, real_time=True)
    robot.connect()
    first, second = wander(env, 30)[[9, 29]]

    def pass_time(seconds: float, goal: np.ndarray, steps: int) -> None:
        wall.now += seconds
        robot.bus.sync_read("Present_Position")
        for _ in range(steps):
            env.step(goal[None])
        np.testing.assert_array_equal(robot.world.simulation.qpos, env.simulation.qpos)

    robot.send_action(as_action(env, first))
    pass_time(0.51, first, 15)
    pass_time(0.02, first, 0)
    pass_time(0.02, first, 1)
    wall.now += 0.1
    robot.send_action(as_action(env, second))
    for _ in range(3):
        env.step(first[None])
    pass_time(0.1, second, 3)
    # Of a long pause 10 s are simulated, and what comes after it is on time.
    pass_time(1000, second, 300)
    pass_time(0.1, second, 3)
    assert robot.clock.time() == wall.now


def test_goals_are_limited_and_need_torque(tmp_path):
    robot = make_robot(tmp_path, max_relative_target=5.0)
    robot.connect()
    before = robot.get_observation()
    sent = robot.send_action({name: value + 20 for name, value in before.items()})
    assert sent == pytest.approx({name: value + 5 for name, value in before.items()})
    robot.bus.disable_torque("gripper")
    robot.bus.write("Goal_Position", "gripper", 90.0)
    robot.bus.write("Goal_Position", "elbow_flex", 12.0)
    assert robot.bus.read("Goal_Position", "gripper") == sent["gripper.pos"]
    assert robot.bus.read("Goal_Position", "elbow_flex") == 12.0
    assert robot.bus.sync_read("Torque_Enable", ["gripper", "elbow_flex"]) == {"gripper": 0, "elbow_flex": 1}
    with pytest.raises(KeyError, match="Present_Load"):
        robot.bus.read("Present_Load", "gripper")


def test_calibration_is_lerobots_file_and_nobody_is_asked(tmp_path, monkeypatch):
    monkeypatch.setattr("builtins.input", lambda *_: pytest.fail("somebody was asked"))
    first = make_robot(tmp_path)
    assert not first.is_calibrated
    first.connect()
    assert first.is_calibrated
    pan, gripper = (first.calibration[name] for name in ("shoulder_pan", "gripper"))
    assert (pan.id, gripper.id) == (1, 6)
    assert (pan.range_max - pan.range_min) * 360 / 4095 == pytest.approx(220, abs=0.1)
    first.disconnect()
    file = tmp_path / "desk.json"
    file.write_text(file.read_text().replace('"homing_offset": 0', '"homing_offset": 7'))
    second = make_robot(tmp_path)
    second.connect()
    assert {one.homing_offset for one in second.bus.read_calibration().values()} == {7}
    # It is not written where a real arm of the same id has its own.
    monkeypatch.setattr("lerobot_robot_cronos.so101.HF_LEROBOT_CALIBRATION", tmp_path)
    assert (
        make_robot(tmp_path, calibration_dir=None).calibration_fpath == tmp_path / "robots/cronos_so101/desk.json"
    )


def test_a_lost_cable_raises_until_it_is_connected_anew(tmp_path):
    robot = make_robot(tmp_path, **CAMERAS)
    with pytest.raises(DeviceNotConnectedError):
        robot.get_observation()
    robot.connect()
    with pytest.raises(DeviceAlreadyConnectedError):
        robot.connect()
    qpos = robot.world.simulation.qpos.copy()
    front, action = robot.cameras["front"], dict.fromkeys(robot.action_features, 0.0)
    front.unplug()
    for read in (front.read, front.async_read, front.read_latest, robot.get_observation):
        with pytest.raises(RuntimeError, match="not running"):
            read()
    robot.bus.unplug()
    for access in (robot.get_observation, lambda: robot.send_action(action), robot.disconnect):
        with pytest.raises(ConnectionError, match="Failed"):
            access()
    assert robot.is_connected
    robot.bus.disconnect(disable_torque=False)
    with pytest.raises(ConnectionError, match="not plugged in"):
        robot.bus.connect()
    robot.bus.plug_in()
    front.plug_in()
    with pytest.raises(RuntimeError):
        front.read()
    front.disconnect()
    robot.bus.connect()
    front.connect()
    assert robot.get_observation()["front"].shape == (48, 64, 3)
    np.testing.assert_array_equal(robot.world.simulation.qpos, qpos)
