"""The SO-101: kinematics, units, servos, the judge at 30 Hz, and what LeRobot and Gymnasium see of it."""

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from env_rollouts import HOME, keep_still, make, run_expert
from lerobot.envs import make_env_config
from lerobot.robots.so_follower import SO101Follower
from lerobot_env_cronos import Scene, ScriptedExpert, Task, gymnasium_id, register_scene
from lerobot_env_cronos.expert.hands import point_down
from lerobot_env_cronos.scene.arms.so101 import kinematics
from lerobot_env_cronos.scene.arms.so101.arm import SO101_ARM, from_joints, to_joints
from lerobot_env_cronos.scene.arms.so101.geometry import EE_OFFSET, EE_SITE, FINGERTIP_REACH
from lerobot_env_cronos.scene.model import build_model
from lerobot_env_cronos.scene.scenes import get_scene
from lerobot_env_cronos.simulation.judging import IN_HAND, ON_TABLE

SCENE = "so101_desk_2x2"
TASK = Task("cube", "plate")
JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build_model(get_scene(SCENE), looks=False)


# Kinematics ----------------------------------------------------------------------------------------------


def test_the_end_effector_at_zero_is_where_the_makers_model_has_it():
    # TheRobotStudio's compiled model: (.020395, -.375601, .258952) in the base's frame, which is turned by 90
    # degrees and stands at (-.023075, -.020791, -.0301).
    p, R = kinematics.forward_kinematics(np.zeros((1, 5)))
    np.testing.assert_allclose(p[0], [0.352526, -0.000396, 0.228852], atol=2e-6)
    # The fingers point forward, the jaw opens upwards.
    np.testing.assert_allclose(R[0] @ [0, 0, -1], [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(R[0] @ [1, 0, 0], [0, 0, 1], atol=1e-6)


def test_pose_and_gravity_equal_mujocos(model):
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for q in rng.uniform(-1.4, 1.4, (5, 5)):
        data.qpos[:6] = [*q, 0.0]
        data.qvel[:] = 0.0
        mujoco.mj_forward(model, data)
        p, R = kinematics.forward_kinematics(q[None])
        np.testing.assert_allclose(p[0], data.site(EE_SITE).xpos, atol=1e-9)
        np.testing.assert_allclose(R[0], data.site(EE_SITE).xmat.reshape(3, 3), atol=1e-9)
        np.testing.assert_allclose(kinematics.gravity_torque(q[None])[0], data.qfrc_bias[:5], atol=1e-3)


def test_inverse_kinematics_come_back():
    rng, n = np.random.default_rng(1), 300
    r, azimuth = rng.uniform(0.12, 0.24, n), rng.uniform(-1.4, 1.4, n)
    goal = np.stack([r * np.cos(azimuth), r * np.sin(azimuth), rng.uniform(0.006, 0.055, n)], 1)
    yaw, tilt = azimuth + rng.uniform(-2.6, 2.6, n), rng.uniform(0.0, 0.2, n)
    q, found = kinematics.inverse_kinematics(goal, yaw, tilt)
    p, R = kinematics.forward_kinematics(q[found])
    assert found.mean() > 0.9
    assert np.linalg.norm(p - goal[found], axis=1).max() < 1e-3
    np.testing.assert_allclose(R[:, 2, 2], np.cos(tilt[found]), atol=1e-6)


def test_a_hand_on_the_pan_axis_has_joint_positions_and_is_not_there():
    yaw = np.array([0.3])
    above = kinematics.hand_rotation(np.zeros(1), yaw, np.zeros(1)) @ EE_OFFSET + [0, 0, 0.15]
    # This one is out of reach at every tilt, and comes to the axis at the last one.
    high = np.array([[0.057, 0.002, 0.1]])
    with np.errstate(all="raise"):
        for q, found in (
            kinematics.inverse_kinematics(above, yaw, np.zeros(1)),
            point_down(high, np.zeros(1)),
        ):
            assert np.isfinite(q).all()
            assert not found


def test_the_hand_gets_down_as_far_as_measured_and_leans_beyond():
    # Straight down at 10 mm: .054 to .275 m.
    for r, straight in ((0.06, True), (0.22, True), (0.285, False)):
        p = np.array([[r, 0.0, 0.01]])
        q, found = point_down(p, np.array([1.0]))
        tilt = np.arccos(min(kinematics.forward_kinematics(q)[1][0, 2, 2], 1.0))
        assert found
        assert (tilt < 0.01) == straight


# LeRobot's features --------------------------------------------------------------------------------------


def test_names_and_robot_type_are_those_of_the_real_arm():
    env = make(1, SCENE)
    names = [f"{joint}.pos" for joint in JOINTS]
    assert env.action_names == env.state_names == names
    assert (env.robot_type, env.fps, env.steps_per_task) == (SO101Follower.name, 30, 480)
    assert env.metadata["render_fps"] == 30


def test_degrees_and_the_grippers_hundred():
    joints = np.deg2rad([[10, -20, 30, -40, 50, 100], [0, 0, 0, 0, 0, -10], [0, 0, 0, 0, 0, 45]])
    np.testing.assert_allclose(
        from_joints(joints), [[10, -20, 30, -40, 50, 100], [0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 50]], atol=1e-9
    )
    np.testing.assert_allclose(to_joints(from_joints(joints)), joints, atol=1e-12)
    space = make(1, SCENE).single_action_space
    np.testing.assert_array_equal(space.low, [-110, -100, -np.float32(96.8), -95, -160, 0])
    np.testing.assert_array_equal(space.high, [110, 100, np.float32(96.8), 95, 160, 100])


def test_the_servos_go_to_an_absolute_target_and_sag():
    env, target = make(1, SCENE), HOME + np.array([20, 10, -10, -15, 30, 25])
    assert np.abs(env.observe()["agent_pos"][0] - HOME).max() < 1e-3
    for _ in range(60):
        observation, *_ = env.step(target[None])
    error = observation["agent_pos"][0] - target
    # Torque over stiffness: degrees at lift and elbow, next to nothing where no weight pulls.
    q = to_joints(target[None])[:, :5]
    sag = np.rad2deg(-kinematics.gravity_torque(q)[0] / 8.9)
    np.testing.assert_allclose(error[:5], sag, atol=0.8)
    assert 0.5 < np.abs(error[1:3]).max() < 6
    assert abs(error[5]) < 0.5


def test_no_link_goes_through_the_table():
    env, rng, lowest = make(16, SCENE), np.random.default_rng(0), 1.0
    space = env.single_action_space
    for _ in range(8):
        action = rng.uniform(space.low, space.high, (16, 6))
        for _ in range(25):
            _, _, _, _, info = env.step(action)
            p, R = env.simulation.end_effector()
            lowest = min(lowest, (p - FINGERTIP_REACH * R[:, :, 2])[:, 2].min())
            assert not info["diverged"].any()
    assert lowest > -0.004


# The judge at 30 Hz --------------------------------------------------------------------------------------


def test_it_reads_every_fifth_of_a_second_and_sees_grasps_at_once():
    env = make(1, SCENE)
    poses, reads, judge = [], [], env.simulation.judge
    read, grasps = judge.read, judge.read_grasps
    judge.read = lambda *args, **options: (reads.append("places"), read(*args, **options))[1]
    judge.read_grasps = lambda *args: (reads.append("grasps"), grasps(*args))[1]
    for _ in range(12):
        env.step(HOME[None])
        poses.append(judge.pose.copy())
    assert reads == (["grasps"] * 5 + ["places"]) * 2


def test_a_placement_takes_a_carry_of_three_readings_and_two_at_rest():
    env = make(1, SCENE)
    env.set_task([0], [TASK])
    expert, held, released, success = ScriptedExpert(env), [], None, None
    for step in range(200):
        env.step(expert.act())
        judge = env.simulation.judge
        held.append(judge.held[0, 0])
        if released is None and judge.carried_to[0, 0] == IN_HAND and not judge.grasped[0, 0]:
            released = step
        if env.is_success[0]:
            success = step
            break
    assert max(held) == 3
    assert released is not None
    # Two readings 0.2 s apart, the first up to 0.2 s after the hand is gone.
    assert 6 <= success - released <= 40


def test_an_object_on_a_receptacle_counts_only_if_it_was_carried():
    env, pose = make(2, SCENE), None
    everyone = np.arange(2)
    env.set_task(everyone, [TASK] * 2)
    poses = env.simulation.body_poses().copy()
    plate, cube = (get_scene(SCENE).bodies.index(name) for name in ("plate", "cube"))
    pose = poses[:, plate].copy()
    pose[:, 2] = 0.007 + 0.0125
    poses[:, cube] = pose
    env.place_bodies(everyone, poses)
    env.simulation.judge.carried_to[0] = ON_TABLE
    success = keep_still(env, 18)
    assert not success[:, 0].any()
    assert success[-1, 1]
    assert not success[:5].any()


# Streams -------------------------------------------------------------------------------------------------


def test_state_continues_bit_for_bit_between_two_readings():
    env = make(4, SCENE)
    env.set_task(np.arange(4), env.tasks)
    expert = ScriptedExpert(env)
    actions = []
    for _ in range(45):  # a hand is closing, and 45 is no multiple of 6
        actions.append(expert.act())
        env.step(actions[-1])
    state, later = env.get_state(), []
    for _ in range(2):
        env.set_state(state)
        for k in range(20):
            observation, reward, *_ = env.step(actions[-1] + k)
        later.append((observation, reward, env.get_state()))
    for one, other in zip(*(item[2].values() for item in later), strict=True):
        np.testing.assert_array_equal(one, other)


def test_end_effector_reset_lets_fall_and_put_back_finds_a_place_within_reach():
    env, rng = make(1, SCENE), np.random.default_rng(0)
    env.set_task([0], [TASK])
    expert = ScriptedExpert(env)
    for _ in range(200):
        env.step(expert.act())
        if env.simulation.judge.held[0, 0] == 3:
            break
    env.end_effector_reset(np.array([0]))
    np.testing.assert_allclose(env.simulation.qpos[0, :6], SO101_ARM.home_qpos, atol=0.1)
    assert env.simulation.body_pose("cube")[0, 2] < 0.04
    assert not env.is_grasped.any()
    for _ in range(5):
        env.put_back(0, env.scene.bodies.index("cube"), rng)
        assert SO101_ARM.serves(env.simulation.body_pose("cube")[0, :2])
        assert not env.unsuitable_bodies().any()


def test_what_lies_at_the_foot_or_out_of_reach_is_unsuitable():
    env = make(3, SCENE)
    poses = env.simulation.body_poses().copy()
    for i, xy in enumerate(((0.2, 0.0), (0.35, 0.0), (-0.1, 0.05))):
        poses[i, 0, :2] = xy
    env.place_bodies(np.arange(3), poses)
    assert env.unsuitable_bodies()[:, 0].tolist() == [False, True, True]


def test_it_solves_the_tasks_from_what_streams_leave_behind():
    """Standing, leaning and stacked things: dropped at random over the reach."""
    env, rng, n = make(24, SCENE), np.random.default_rng(2), 24
    poses = env.simulation.body_poses().copy()
    turn = rng.normal(size=(n, 2, 4))
    poses[:, :2, 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    poses[:, :2, 2] = 0.07
    env.place_bodies(np.arange(n), poses)
    env.set_task(np.arange(n), [env.tasks[i % 4] for i in range(n)])
    keep_still(env, 30)
    assert run_expert(env).mean() >= 0.85


# Frameworks ----------------------------------------------------------------------------------------------


def test_gymnasium_and_lerobot_make_it():
    env = gym.make(gymnasium_id(SCENE), camera_name="front,wrist")
    observation, _ = env.reset(seed=0)
    assert env.spec.max_episode_steps == 480
    assert env.metadata["render_fps"] == 30
    first = observation["pixels"]["wrist"].copy()
    for _ in range(10):
        observation, *_ = env.step(HOME.astype(np.float32) + np.float32([40, 0, 0, 0, 0, 0]))
    env.close()
    # It moves with the gripper.
    assert np.abs(observation["pixels"]["wrist"].astype(int) - first).mean() > 5
    config = make_env_config("cronos", scene=SCENE, camera_name="front,wrist", task_observation="one_hot")
    assert config.fps == 30
    assert config.features["action"].shape == (6,)
    assert config.features["agent_pos"].shape == (6 + 2 + 3,)
    assert {"observation.images.front", "observation.images.wrist"} <= config.features.keys()
    with pytest.raises(ValueError, match="bridge"):
        make_env_config("cronos", scene=SCENE, camera_name="bridge")
    with pytest.raises(ValueError, match="30 Hz"):
        make_env_config("cronos", scene=SCENE, fps=5)


def test_a_moving_camera_has_no_projection_and_no_camera_without_the_bodies():
    options = {"obs_type": "pixels_agent_pos", "camera_name": "front,wrist"}
    details = make(1, SCENE, privileged_state=True, **options).observation_details
    assert "observation.images.wrist" not in details
    assert np.shape(details["observation.images.front"]["projection"]) == (3, 4)
    assert "observation.images.front" not in make(1, SCENE, **options).observation_details


def test_a_scene_of_your_own_declares_the_arm(monkeypatch):
    monkeypatch.setattr("lerobot_env_cronos.benchmark.registry.SCENES", {})
    with pytest.raises(ValueError, match="unknown arm 'so100'"):
        Scene("shelf", ("cube",), ("mat",), arm="so100")
    with pytest.raises(ValueError, match="spawn_low"):
        register_scene(Scene("shelf", ("cube",), ("mat",), arm="so101"))
    with pytest.raises(ValueError, match="the gripper takes less than 45 mm"):
        register_scene(Scene("shelf", ("mat",), ("plate",), (0.1, -0.2), (0.25, 0.2), arm="so101"))
