"""The detector of unsuitable scenes, each reason by moving a body there, and putting bodies back."""

from dataclasses import replace

import numpy as np
import pytest
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.benchmark import configurations
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX
from lerobot_env_cronos.scene.scenes import BODIES
from lerobot_env_cronos.simulation.workspace import Unsuitable, find_free_pose, find_unsuitable

UPRIGHT = [1.0, 0.0, 0.0, 0.0]
ON_EDGE = [np.cos(np.pi / 4), np.sin(np.pi / 4), 0.0, 0.0]


@pytest.fixture(scope="module")
def env():
    return CronosVectorEnv(2, obs_type="environment_state_agent_pos", num_threads=1)


@pytest.mark.parametrize(
    ("body", "pose", "reasons"),
    [
        ("ketchup bottle", [0.30, 0.10, 0.011, *UPRIGHT], set()),
        ("ketchup bottle", [0.05, 0.00, 0.011, *UPRIGHT], {Unsuitable.OUTSIDE}),  # behind the reach, in view
        ("cloth", [0.40, 0.27, 0.005, *UPRIGHT], {Unsuitable.UNSEEN}),  # in reach, beside the picture
        ("cloth", [0.30, 0.10, 0.055, *ON_EDGE], {Unsuitable.FALLEN}),
        ("kitchen shovel", [0.30, 0.10, 0.074, *ON_EDGE], set()),  # objects may lie as they like
        (
            "yellow plate",
            [0.80, 0.50, -0.74, *UPRIGHT],
            {Unsuitable.OUTSIDE, Unsuitable.FALLEN, Unsuitable.UNSEEN},
        ),
    ],
)
def test_every_reason(env, body, pose, reasons):
    env.reset(seed=0)
    assert not env.unsuitable_bodies().any()
    env.simulation.move_body(np.array([1]), body, np.array([pose]))
    found = find_unsuitable(env.simulation)
    k = env.scene.bodies.index(body)
    assert {reason for reason, where in found.items() if where[1, k]} == reasons
    assert env.unsuitable_bodies().sum() == bool(reasons)


def test_view_is_that_of_the_rendered_picture():
    """The bottle alone is moved along the predicted edge of the picture: seen just inside, not just outside."""
    env = CronosVectorEnv(1, camera_name="front", num_threads=1)
    env.reset(seed=0)
    y = np.linspace(0.1, 0.3, 201)
    line = np.stack([np.full_like(y, 0.30), y, np.full_like(y, 0.011)], axis=1)
    edge = y[WIDOWX.sees(line)].max()

    def picture(offset):
        pose = np.array([[0.30, edge + offset, 0.011, *UPRIGHT]])
        env.simulation.move_body(np.array([0]), "ketchup bottle", pose)
        return env.observe()["pixels"]["front"][0].astype(int)

    far = picture(0.2)
    assert np.abs(picture(0.06) - far).max() <= 8  # 6 cm outside, half a bottle is 4
    assert np.abs(picture(0.0) - far).max() > 30
    env.close()


def test_put_back_makes_the_scene_suitable_and_touches_nothing_else(env):
    env.reset(seed=0)
    before = env.simulation.body_poses().copy()
    ids = np.array([0])
    env.simulation.move_body(ids, "cloth", np.array([[0.8, 0.5, -0.74, *UPRIGHT]]))
    env.put_back(0, env.scene.bodies.index("cloth"), np.random.default_rng(0))
    assert not env.unsuitable_bodies().any()
    k = env.scene.bodies.index("cloth")
    after = env.simulation.body_poses()
    others = [i for i in range(len(env.scene.bodies)) if i != k]
    np.testing.assert_allclose(after[0, others], before[0, others], atol=1e-4)
    np.testing.assert_array_equal(after[1], before[1])
    assert not np.allclose(after[0, k], before[0, k])


def test_put_back_keeps_clear_of_a_low_hand(env):
    env.reset(seed=0)
    down = np.array([[0, 0, -0.026, 0, 0, 0, 1.0]] * 2)
    for _ in range(8):
        env.step(down)
    hand = env.simulation.end_effector()[0][0]
    assert hand[2] < 0.12
    rng = np.random.default_rng(0)
    for _ in range(20):
        env.put_back(0, env.scene.bodies.index("ketchup bottle"), rng)
        pose = env.simulation.body_pose("ketchup bottle")[0]
        assert np.abs(pose[:2] - hand[:2]).max() > 0.06


@pytest.mark.parametrize("has_room", [True, False])
def test_bodies_are_put_back_where_the_camera_sees_them(env, monkeypatch, has_room):
    """In a spawn area as wide as the workspace, of whose width the camera sees less than nine tenths."""
    env.reset(seed=0)
    wide = replace(env.scene, spawn_low=(0.2, -0.3), spawn_high=(0.4, 0.3))
    monkeypatch.setattr(env.simulation, "scene", wide)
    if not has_room:
        monkeypatch.setattr(configurations, "CLEARANCE_M", 1.0)
        monkeypatch.setattr(configurations, "MAX_ATTEMPTS", 20)
    rng = np.random.default_rng(0)
    poses = np.array([find_free_pose(env.simulation, 0, "ketchup bottle", rng) for _ in range(100)])
    assert ((poses[:, 2] < 0.1) == has_room).all()
    assert np.abs(poses[:, 1]).max() > 0.2
    poses[:, 2] = BODIES["ketchup bottle"].size[2] / 2
    assert WIDOWX.sees(poses[:, :3]).all()
