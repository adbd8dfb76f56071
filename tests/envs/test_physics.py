"""Friction of the table against Coulomb's law, in plain MuJoCo with sleep and motors off; speed, depth, motion."""

import mujoco
import numpy as np
import pytest
from env_rollouts import WIDOWX_SCENES, make
from lerobot_env_cronos import get_scene
from lerobot_env_cronos.scene.arms.widowx.geometry import EE_SITE, HOME_QPOS
from lerobot_env_cronos.scene.arms.widowx.kinematics import forward_kinematics, inverse_kinematics
from lerobot_env_cronos.scene.model import build_model
from lerobot_env_cronos.scene.rotations import (
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)
from lerobot_env_cronos.scene.scenes import BODIES

SCENE, GRAVITY = "kitchen_2x2", 9.81
FLAT = get_scene(SCENE).receptacles


def flat_body_on_the_table(body: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = build_model(get_scene(SCENE), looks=False)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    data = mujoco.MjData(model)
    for i, name in enumerate(get_scene(SCENE).bodies):
        x, y = (0.3, 0.0) if name == body else (-0.1, -0.36 + 0.14 * i)
        data.joint(name).qpos[:] = [x, y, BODIES[name].size[2] / 2, 1, 0, 0, 0]
    data.qpos[:6] = [0, -1.0, 0, 0, 0, 0]  # The hand is far above.
    advance(model, data, 0.5)
    return model, data


def advance(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> None:
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)


@pytest.mark.parametrize("body", FLAT)
@pytest.mark.parametrize(("slope", "expected", "tolerance"), [(0.9, 0.0, 0.0005), (1.1, 0.0825, 0.003)])
def test_a_slope_holds_below_the_friction_angle_and_not_above(body, slope, expected, tolerance):
    model, data = flat_body_on_the_table(body)
    angle, before = np.arctan(slope), data.joint(body).qpos[0]
    model.opt.gravity[:] = GRAVITY * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    advance(model, data, 0.5)
    # Friction 1: above 45 degrees it slides g (sin - cos) t^2 / 2 = 9.81 x 0.0673 x 0.25 / 2 = 82.5 mm.
    assert data.joint(body).qpos[0] - before == pytest.approx(expected, abs=tolerance)


@pytest.mark.parametrize("body", FLAT)
def test_a_body_let_go_at_speed_stops_where_coulomb_says(body):
    model, data = flat_body_on_the_table(body)
    before = data.joint(body).qpos[0]
    data.joint(body).qvel[0] = 0.5
    advance(model, data, 1.0)
    # v^2 / (2 mu g) = 0.25 / 19.62 = 12.7 mm.
    assert data.joint(body).qpos[0] - before == pytest.approx(0.0127, abs=0.001)
    # At rest: 1 mm/s, and half a millimetre a second at the rim.
    assert np.abs(data.joint(body).qvel[:3]).max() < 1e-3
    assert np.abs(data.joint(body).qvel[3:]).max() < 1e-2


def test_tasks_sizes_and_masses_are_the_papers():
    assert [task.instruction for task in get_scene(SCENE).tasks] == [
        "put the ketchup bottle on the yellow plate",
        "put the ketchup bottle on the cloth",
        "put the kitchen shovel on the yellow plate",
        "put the kitchen shovel on the cloth",
    ]
    masses = {}
    for scene in WIDOWX_SCENES:
        model = build_model(get_scene(scene), looks=False)
        masses |= {body: model.body(body).mass[0] for body in get_scene(scene).bodies}
    # Volumes by hand, times the published densities.
    assert masses["yellow plate"] == pytest.approx(np.pi * 0.055**2 * 0.006 * 1003)
    assert masses["cloth"] == pytest.approx(0.110 * 0.110 * 0.0094 * 6975)
    assert masses["carpet"] == pytest.approx(0.110 * 0.0943 * 0.0037 * 2815)
    assert masses["newspaper"] == pytest.approx(0.0815 * 0.1161 * 0.0041 * 2278)
    # A body of 55 % of the height, and a head that is 0.75 as deep and 0.85 as wide.
    assert masses["toy bear"] == pytest.approx((0.55 + 0.45 * 0.75 * 0.85) * 0.0426 * 0.0386 * 0.0564 * 667)
    # A belly of 72 % of the length and a neck 0.55 as thick.
    assert masses["plastic bottle"] == pytest.approx((0.72 + 0.28 * 0.55**2) * 0.0361 * 0.1216 * 0.0390 * 1916)
    arm = [0.480879, 0.430811, 0.234589, 0.220991, 0.084957, 0.110084]
    names = ["shoulder", "upper_arm", "upper_forearm", "lower_forearm", "wrist", "gripper"]
    assert [model.body(f"{name}_link").mass[0] for name in names] == pytest.approx(arm)


def test_a_body_that_spins_fast_slows_down_and_one_pressed_down_stays_on_the_table():
    env = make(2)
    env.reset(seed=0)
    sim, everyone = env.simulation, np.arange(2)
    # Out of a pinch: without a limit a spin of 140 rad/s grows beyond 10,000 within a second.
    sim.qpos[0, 8:11] = [0.3, 0.0, 0.4]
    sim.qvel[0, 8:14] = [0, 0, 2.0, 100.0, 100.0, 10.0]
    # A hand that leans on it: 25 mm deep, past the middle of the board that is drawn.
    sim.qpos[1, 8:11] = [0.3, 0.0, -0.025]
    for _ in range(10):
        diverged = sim.step(np.tile([0, 0, 0, 0, 0, 0, 1.0], (2, 1)), everyone)
        assert not diverged.any()
        spin, speed = np.linalg.norm(sim.qvel[:, 11:14], axis=1), np.linalg.norm(sim.qvel[:, 8:11], axis=1)
        assert (spin <= 50.0 + 1e-9).all()
        assert (speed <= 3.0 + 1e-9).all()
    assert (sim.qpos[:, 10] > 0).all()


# Kinematics ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def model():
    return build_model(get_scene("kitchen_2x2"))


def test_the_batched_kinematics_pose_and_jacobian_equal_mujocos(model):
    data = mujoco.MjData(model)
    site = model.site(EE_SITE).id
    q = HOME_QPOS + np.random.default_rng(0).uniform(-0.5, 0.5, (5, 6))
    p, R, jacobian = forward_kinematics(q)
    for i in range(len(q)):
        data.qpos[:6] = q[i]
        mujoco.mj_forward(model, data)
        jacp, jacr = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacp, jacr, site)
        np.testing.assert_allclose(p[i], data.site_xpos[site], atol=1e-12)
        np.testing.assert_allclose(R[i].ravel(), data.site_xmat[site], atol=1e-12)
        np.testing.assert_allclose(jacobian[i], np.vstack([jacp, jacr])[:, :6], atol=1e-12)


def test_inverse_kinematics_reaches_one_action_away():
    q = np.tile(HOME_QPOS, (20, 1))
    p, R, _ = forward_kinematics(q)
    rng = np.random.default_rng(1)
    p_target = p + rng.uniform(-0.03, 0.03, p.shape)
    R_target = rotation_vector_to_matrix(rng.uniform(-0.1, 0.1, p.shape)) @ R
    p_found, R_found, _ = forward_kinematics(inverse_kinematics(q, p_target, R_target))
    assert np.abs(p_found - p_target).max() < 1e-3
    assert np.abs(matrix_to_rotation_vector(R_target @ R_found.transpose(0, 2, 1))).max() < 1e-2


def test_rotations_have_the_textbook_values():
    quarter = rotation_vector_to_matrix(np.array([0, 0, np.pi / 2]))
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(matrix_to_rotation_vector(quarter), [0, 0, np.pi / 2], atol=1e-12)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quaternion_to_matrix(np.array([half, 0, 0, half])), quarter, atol=1e-12)
