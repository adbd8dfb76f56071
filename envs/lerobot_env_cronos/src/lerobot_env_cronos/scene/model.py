"""The MuJoCo model of a scene, built with MjSpec."""

from typing import Any

import mujoco
import numpy as np

from lerobot_env_cronos.scene import visuals
from lerobot_env_cronos.scene.bodies import add_body
from lerobot_env_cronos.scene.physics import INTEGRATOR, SOLREF, TIMESTEP_S
from lerobot_env_cronos.scene.robot import CONTACT_SOLIMP, add_robot
from lerobot_env_cronos.scene.scenes import BODIES, Scene

TABLE_LOW, TABLE_HIGH, TABLE_THICKNESS = (-0.20, -0.45), (0.70, 0.45), 0.30
"""Table top in the base frame, surface at z = 0 [m]. A body pushed over its edge falls to the floor. Contacts push
out along the shortest way: a hand that leans on a body would press it through the thin board that is drawn."""
FLOOR_Z = -0.75

CAMERAS: dict[str, dict[str, Any]] = {
    # A front view, 45 degrees down through a long lens: bodies at the edges of the widened spawn area just fit
    # the width of a square picture, and little is lost behind the arm.
    "front": {"pos": [1.03, 0, 0.82], "xyaxes": [0, 1, 0, -1, 0, 1], "fovy": 27.0},
    # The Bridge set-up's third-person Logitech C920, as identified by SimplerEnv.
    "bridge": {
        "pos": [0.0, -0.16, 0.36],
        "xyaxes": [0.483933, -0.875105, 0.0, 0.602558, 0.333214, 0.725184],
        "fovy": 42.1004,
    },
}
"""Fixed cameras by name: position [m], image x and y axes, vertical field of view [deg]."""


def grasp_sensor(side: str, obj: str) -> str:
    """Name of the sensor of the force between one finger and an object."""
    return f"{side}_pad/{obj}"


def hand_sensor(obj: str) -> str:
    """Name of the sensor of the number of contacts between the hand, palm and fingers, and an object."""
    return f"hand/{obj}"


TABLE = "table"
"""Name of the table's geom, and of the table as what objects lie on."""


def support_sensor(obj: str, support: str) -> str:
    """Name of the sensor of the force of a receptacle, or of `TABLE`, on an object."""
    return f"{obj}/{support}"


def build_spec(scene: Scene, looks: bool = True) -> mujoco.MjSpec:
    """Build the scene's MjSpec: table, floor, WX250S, free bodies, cameras, contact sensors, and their looks."""
    spec = mujoco.MjSpec()
    spec.modelname = scene.name
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    _set_options(spec)
    _add_furniture(spec)
    add_robot(spec)
    bodies = {name: add_body(spec, BODIES[name]) for name in scene.bodies}
    _add_contact_sensors(spec, scene)
    for name, camera in CAMERAS.items():
        spec.worldbody.add_camera(
            name=name, pos=camera["pos"], fovy=camera["fovy"], quat=_camera_quat(camera["xyaxes"])
        )
    if looks:
        visuals.dress(spec, bodies)
    return spec


def build_model(scene: Scene, looks: bool = True) -> mujoco.MjModel:
    """Compile the scene's model; what it looks like has no mass, touches nothing, and costs physics time."""
    return build_spec(scene, looks).compile()


def camera_axes(name: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Position (3,) [m], rotation (3, 3) with the image's x, y and the backward axis as columns, and half the
    vertical field of view [rad] of a camera in the base frame."""
    camera = CAMERAS[name]
    return np.array(camera["pos"]), _camera_rotation(camera["xyaxes"]), np.deg2rad(camera["fovy"]) / 2


def _camera_rotation(xyaxes: list[float]) -> np.ndarray:
    """Rotation matrix of a camera from its image x and y axes, made orthonormal."""
    x, y = np.array(xyaxes[:3]), np.array(xyaxes[3:])
    x = x / np.linalg.norm(x)
    y = y - x * (x @ y)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _camera_quat(xyaxes: list[float]) -> np.ndarray:
    """Orientation (w, x, y, z) of a camera from its image x and y axes."""
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, _camera_rotation(xyaxes).ravel())
    return quat


def _set_options(spec: mujoco.MjSpec) -> None:
    spec.default.geom.solref = spec.default.equality.solref = SOLREF
    option = spec.option
    option.timestep = TIMESTEP_S
    option.integrator = INTEGRATOR
    # Elliptic cones and a high friction-to-normal impedance ratio: grasped objects do not creep.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # Bodies at rest cost nothing: three times as many steps per second.
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    option.sleep_tolerance = 1e-3
    # A simulation that diverges is reported by `Simulation.step`, not silently put back to qpos0.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)


def _add_furniture(spec: mujoco.MjSpec) -> None:
    size = [(hi - lo) / 2 for lo, hi in zip(TABLE_LOW, TABLE_HIGH, strict=True)]
    centre = [(hi + lo) / 2 for lo, hi in zip(TABLE_LOW, TABLE_HIGH, strict=True)]
    contact = {
        "friction": [1.0, 0.01, 0.003],
        "condim": 6,
        "solimp": CONTACT_SOLIMP,
    }
    spec.worldbody.add_geom(
        name=TABLE, type=mujoco.mjtGeom.mjGEOM_BOX, size=[*size, TABLE_THICKNESS / 2],
        pos=[*centre, -TABLE_THICKNESS / 2], group=3, **contact,
    )  # fmt: skip
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[3, 3, 0.1],
        pos=[0, 0, FLOOR_Z],
        group=3,
        **contact,
    )


def _add_contact_sensors(spec: mujoco.MjSpec, scene: Scene) -> None:
    """What success and grasp are judged from: net contact forces on each object, world frame [N], and contacts."""
    force, found = mujoco.mjtConDataField.mjCONDATA_FORCE, mujoco.mjtConDataField.mjCONDATA_FOUND
    geom, body, subtree = mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
    for obj in scene.objects:
        for side in ("left", "right"):
            _add_contact_sensor(spec, grasp_sensor(side, obj), (geom, f"{side}_pad"), obj, force)
        _add_contact_sensor(spec, hand_sensor(obj), (subtree, "gripper_link"), obj, found)
        _add_contact_sensor(spec, support_sensor(obj, TABLE), (geom, TABLE), obj, force)
        for receptacle in scene.receptacles:
            _add_contact_sensor(spec, support_sensor(obj, receptacle), (body, receptacle), obj, force)


def _add_contact_sensor(
    spec: mujoco.MjSpec, name: str, other: tuple[mujoco.mjtObj, str], obj: str, field: mujoco.mjtConDataField
) -> None:
    """Add a sensor of the contacts of `other` with `obj`: net force on it (3,), or their number (1,)."""
    net_force, num = 3, 1
    spec.add_sensor(
        name=name, type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=other[0], objname=other[1],
        reftype=mujoco.mjtObj.mjOBJ_BODY, refname=obj, intprm=[1 << int(field), net_force, num],
    )  # fmt: skip
