"""The batched kinematics against MuJoCo's own."""

import mujoco
import numpy as np
import pytest
from lerobot_env_cronos import get_scene
from lerobot_env_cronos.scene.model import build_model
from lerobot_env_cronos.scene.robot import EE_SITE, HOME_QPOS
from lerobot_env_cronos.simulation.kinematics import (
    forward_kinematics,
    inverse_kinematics,
    matrix_to_rotation_vector,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
)


@pytest.fixture(scope="module")
def model():
    return build_model(get_scene("kitchen_2x2"))


def test_pose_and_jacobian_equal_mujocos(model):
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
