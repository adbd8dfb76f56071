"""The MuJoCo model of a scene, built with MjSpec."""

from collections.abc import Callable

import mujoco

from lerobot_env_cronos.scene import visuals
from lerobot_env_cronos.scene.arms.arm import Arm
from lerobot_env_cronos.scene.arms.so101.model import add_robot as add_so101
from lerobot_env_cronos.scene.arms.widowx.model import add_robot as add_widowx
from lerobot_env_cronos.scene.bodies import add_body
from lerobot_env_cronos.scene.cameras import camera_quaternion
from lerobot_env_cronos.scene.contacts import CONTACT_SOLIMP
from lerobot_env_cronos.scene.scenes import BODIES, Scene

# With the implicit integrators what a hand holds slips up to three times as far at long time steps: they damp the
# arm after the contacts were solved.
INTEGRATOR = mujoco.mjtIntegrator.mjINT_EULER

SETTLE_CHUNK_S = 0.1
"""How often bodies that settle are looked at [s]."""

ADD_ROBOT: dict[str, Callable[[mujoco.MjSpec], None]] = {"widowx": add_widowx, "so101": add_so101}
"""How to build an arm, by its name."""

TABLE_LOW, TABLE_HIGH, TABLE_THICKNESS = (-0.20, -0.45), (0.70, 0.45), 0.30
"""Table top in the base frame, surface at z = 0 [m]. A body pushed over its edge falls to the floor. Contacts push
out along the shortest way: a hand that leans on a body would press it through the thin board that is drawn."""
FLOOR_Z = -0.75


SIDES = ("left", "right")
"""Of the hand, in the order of `Arm.fingers`."""


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
    """Build the scene's MjSpec: table, floor, arm, free bodies, cameras, contact sensors, and their looks."""
    spec = mujoco.MjSpec()
    spec.modelname = scene.name
    spec.compiler.degree = False
    spec.compiler.autolimits = True
    _set_options(spec, scene.robot)
    _add_furniture(spec)
    ADD_ROBOT[scene.arm](spec)
    bodies = {name: add_body(spec, BODIES[name]) for name in scene.bodies}
    _add_contact_sensors(spec, scene)
    for name, camera in scene.robot.cameras.items():
        mount = spec.body(camera.body) if camera.body else spec.worldbody
        mount.add_camera(name=name, pos=camera.pos, fovy=camera.fovy, quat=camera_quaternion(camera))
    if looks:
        visuals.dress(spec, scene, bodies)
    return spec


def build_model(scene: Scene, looks: bool = True) -> mujoco.MjModel:
    """Compile the scene's model; what it looks like has no mass, touches nothing, and costs physics time."""
    return build_spec(scene, looks).compile()


def _set_options(spec: mujoco.MjSpec, arm: Arm) -> None:
    # Time constant [s] and damping ratio of contacts: as stiff as the time step allows.
    spec.default.geom.solref = spec.default.equality.solref = (2 * arm.timestep_s, 1.0)
    option = spec.option
    option.timestep = arm.timestep_s
    option.integrator = INTEGRATOR
    # Elliptic cones and a high friction-to-normal impedance ratio: grasped objects do not creep.
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 10.0
    # Bodies at rest cost nothing: three times as many steps per second.
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    option.sleep_tolerance = arm.sleep_tolerance
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
    arm = scene.robot
    force, found = mujoco.mjtConDataField.mjCONDATA_FORCE, mujoco.mjtConDataField.mjCONDATA_FOUND
    geom, body, subtree = mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_XBODY
    for obj in scene.objects:
        for side, (kind, name) in zip(SIDES, arm.fingers, strict=True):
            finger = {"geom": geom, "body": body}[kind], name
            _add_contact_sensor(spec, grasp_sensor(side, obj), finger, obj, force)
        _add_contact_sensor(spec, hand_sensor(obj), (subtree, arm.hand), obj, found)
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
