"""The cameras' projection, against what MuJoCo draws."""

from itertools import product

import mujoco
import numpy as np
import pytest
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX
from lerobot_env_cronos.scene.scenes import BODIES


@pytest.mark.parametrize("camera", WIDOWX.cameras)
@pytest.mark.parametrize("size", [(240, 240), (240, 320)])
def test_bodies_are_drawn_where_the_projection_says(camera, size):
    env = CronosVectorEnv(1, "kitchen_2x2", obs_type="environment_state_agent_pos")
    env.reset(seed=0)
    model, data = env.simulation.render_model, mujoco.MjData(env.simulation.render_model)
    data.qpos[:] = env.simulation.qpos[0]
    mujoco.mj_forward(model, data)
    renderer = mujoco.Renderer(model, *size)
    renderer.enable_segmentation_rendering()
    renderer.update_scene(data, camera)
    geoms = renderer.render()[..., 0]
    renderer.close()
    projection, tight = WIDOWX.cameras[camera].projection(*size), 0
    for name in env.scene.bodies:
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        drawn = np.argwhere(np.isin(geoms, np.flatnonzero(model.geom_bodyid == body)))[:, ::-1] + 0.5
        corners = np.array(list(product(*[(-side / 2, side / 2) for side in BODIES[name].size])))
        points = corners @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
        u, v, depth = projection @ np.c_[points, np.ones(8)].T
        box = (np.stack([u, v], 1) / depth[:, None] + 1) / 2 * (size[1], size[0])
        if len(drawn):
            margins = np.r_[drawn.min(0) - box.min(0), box.max(0) - drawn.max(0)]
            assert margins.min() > -2
            tight += margins.max() < 5
    # The arm may hide a part of the others.
    assert tight
    env.close()


def test_long_bodies_have_two_ends():
    bottle, plate = BODIES["ketchup bottle"].keypoints, BODIES["yellow plate"].keypoints
    np.testing.assert_allclose(bottle, [(0, 0, 0), (0, 0.8 * 0.0813 / 2, 0), (0, -0.8 * 0.0813 / 2, 0)])
    assert plate == ((0, 0, 0),)
