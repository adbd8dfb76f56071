"""The SO-101's bodies, collision boxes, servos and end-effector site, as an MjSpec tree."""

from typing import Any

import mujoco
import numpy as np

from lerobot_env_cronos.scene.arms.so101.geometry import (
    BASE_POS,
    BASE_QUAT,
    EE_OFFSET,
    EE_SITE,
    FIXED_JAW,
    GRIPPER_TORQUE,
    HOUSINGS,
    JOINTS,
    LINKS,
    MOVING_JAW,
    PAD_FRICTION,
    SERVO_ARMATURE,
    SERVO_DAMPING,
    SERVO_FRICTIONLOSS,
    SERVO_KP,
    SERVO_TORQUE,
    Box,
)
from lerobot_env_cronos.scene.contacts import CONTACT_SOLIMP

# Two geoms collide if either's type is among what the other one meets. The room and its bodies are of type 1.
ROOM, LINK, FOOT = 1, 2, 4
COLLIDES: dict[str, dict[str, int]] = {
    # The hand meets the arm's own foot, too; other links meet nothing of the arm.
    "hand": {"contype": LINK, "conaffinity": ROOM | FOOT},
    "foot": {"contype": FOOT, "conaffinity": ROOM},
    "link": {"contype": LINK, "conaffinity": ROOM},
}
PART_OF = {"base": "foot", "shoulder": "foot", "gripper": "hand", "moving_jaw": "hand"}
PADS: dict[str, tuple[str, tuple[Box, ...]]] = {
    "fixed_jaw": ("gripper", FIXED_JAW),
    "moving_jaw_pads": ("moving_jaw", MOVING_JAW),
}
"""Bodies of the jaws' boxes, and the links that they are parts of: what grasps is told from what only touches."""


def add_robot(spec: mujoco.MjSpec) -> None:
    """Add the arm, its collision geometry, actuators and end-effector site to `spec`.

    Its weight is not compensated: the servos sag under it, as the real ones do.
    """
    bodies = {"base": spec.worldbody.add_body(name="base", pos=BASE_POS, quat=BASE_QUAT)}
    for link in LINKS:
        body = bodies[link.parent].add_body(
            name=link.name, pos=link.pos, quat=link.quat, mass=link.mass, ipos=link.com,
            iquat=link.inertia_quat, inertia=link.diaginertia, explicitinertial=True,
        )  # fmt: skip
        body.add_joint(
            name=link.joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=link.axis, range=link.range, limited=True,
            damping=[SERVO_DAMPING, 0, 0], frictionloss=SERVO_FRICTIONLOSS, armature=SERVO_ARMATURE,
        )  # fmt: skip
        bodies[link.name] = body
    bodies["gripper"].add_site(name=EE_SITE, pos=EE_OFFSET, size=[0.004] * 3, group=4)
    for name, boxes in HOUSINGS.items():
        _add_boxes(bodies[name], boxes, **COLLIDES[PART_OF.get(name, "link")])
    for name, (link, boxes) in PADS.items():
        pads = bodies[link].add_body(name=name)
        _add_boxes(
            pads, boxes, friction=PAD_FRICTION, condim=4, priority=1, solimp=CONTACT_SOLIMP, **COLLIDES["hand"]
        )
    _add_servos(spec)


def _add_boxes(body: mujoco.MjsBody, boxes: tuple[Box, ...], **contact: Any) -> None:
    for low, high in np.array(boxes):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=(low + high) / 2, size=(high - low) / 2, group=3, mass=0, **contact
        )


def _add_servos(spec: mujoco.MjSpec) -> None:
    for joint in JOINTS:
        limit = GRIPPER_TORQUE if joint == JOINTS[-1] else SERVO_TORQUE
        actuator = spec.add_actuator(
            name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True,
            forcerange=[-limit, limit],
        )  # fmt: skip
        actuator.set_to_position(kp=SERVO_KP)
