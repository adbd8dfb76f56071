"""The looks of the scene: inside the bounding boxes, in the picture, cheap, and without any effect on physics."""

import mujoco
import numpy as np
import pytest
from lerobot_env_cronos.scene import model as model_module
from lerobot_env_cronos.scene.model import build_model
from lerobot_env_cronos.scene.scenes import BODIES, SCENES
from lerobot_env_cronos.scene.visuals.meshes import VISUAL_GROUP

SCENE = SCENES["kitchen_2x2"]
BODIES_OF_SCENES = [(scene, body) for scene in SCENES for body in SCENES[scene].bodies]
DYNAMIC_FIELDS = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_iquat",
    "body_subtreemass",
    "dof_armature",
    "qpos0",
)


@pytest.fixture(scope="module")
def models() -> dict[str, mujoco.MjModel]:
    return {name: build_model(scene) for name, scene in SCENES.items()}


@pytest.fixture(scope="module")
def dressed(models) -> mujoco.MjModel:
    return models[SCENE.name]


def visual_vertices(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Vertices of all visual meshes of a body, in the body's frame (n, 3)."""
    parts = []
    for g in np.flatnonzero((model.geom_bodyid == model.body(body).id) & (model.geom_group == VISUAL_GROUP)):
        assert model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH
        mesh, rotation = model.geom_dataid[g], np.empty(9)
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        mujoco.mju_quat2Mat(rotation, model.geom_quat[g])
        parts.append(model.mesh_vert[start : start + count] @ rotation.reshape(3, 3).T + model.geom_pos[g])
    return np.concatenate(parts)


@pytest.mark.parametrize("scene", SCENES)
def test_changes_no_dynamics(models, scene, monkeypatch):
    dressed = models[scene]
    monkeypatch.setattr(model_module.visuals, "dress", lambda *_: None)
    bare = build_model(SCENES[scene])
    for field in DYNAMIC_FIELDS:
        np.testing.assert_array_equal(getattr(dressed, field), getattr(bare, field), err_msg=field)
    collides = dressed.geom_contype != 0
    assert collides.sum() == (bare.geom_contype != 0).sum() == bare.ngeom
    for field in ("geom_type", "geom_size", "geom_pos", "geom_friction", "geom_condim"):
        np.testing.assert_array_equal(getattr(dressed, field)[collides], getattr(bare, field), err_msg=field)
    assert (dressed.geom_conaffinity[~collides] == 0).all()
    assert (dressed.geom_group[~collides] == VISUAL_GROUP).all()


@pytest.mark.parametrize(("scene", "name"), BODIES_OF_SCENES)
def test_body_fills_its_bounding_box_and_stays_inside(models, scene, name):
    vertices, half = visual_vertices(models[scene], name), np.array(BODIES[name].size) / 2
    assert (np.abs(vertices) <= half + 1e-4).all()
    # At least 90 % of the published extent is visible in every direction.
    assert (np.ptp(vertices, axis=0) >= 0.9 * 2 * half).all()
