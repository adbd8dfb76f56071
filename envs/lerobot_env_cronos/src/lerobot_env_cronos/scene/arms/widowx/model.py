"""The WidowX's bodies, collision geometry, actuators and end-effector site, as an MjSpec tree."""

import mujoco

from lerobot_env_cronos.scene.arms.widowx.geometry import (
    ARM_ARMATURE,
    ARM_FORCE_LIMIT,
    ARM_JOINTS,
    ARM_KP,
    EE_OFFSET,
    EE_SITE,
    FINGER_CLOSED,
    FINGER_COM,
    FINGER_DIAGINERTIA,
    FINGER_MASS,
    FINGER_OPEN,
    FINGER_POS,
    GRIPPER_FORCE_LIMIT,
    GRIPPER_KP,
    LINKS,
    PAD_HALF_SIZE,
    PAD_POS,
    PALM_SOLREF,
)
from lerobot_env_cronos.scene.contacts import CONTACT_SOLIMP


def add_robot(spec: mujoco.MjSpec) -> None:
    """Add the arm, its collision geometry, actuators and end-effector site to `spec`.

    Only the gripper collides: the other links stay above everything a task can reach, so leaving them out
    saves collision checks without changing a contact.
    """
    base = spec.worldbody.add_body(name="base_link", gravcomp=1.0)
    bodies = {"base_link": base}
    for link in LINKS:
        body = bodies[link.parent].add_body(
            name=link.name, pos=link.pos, gravcomp=1.0, mass=link.mass, ipos=link.com,
            iquat=link.inertia_quat, inertia=link.diaginertia, explicitinertial=True,
        )  # fmt: skip
        body.add_joint(
            name=link.joint, type=mujoco.mjtJoint.mjJNT_HINGE, axis=link.axis, range=link.range,
            limited=True, armature=ARM_ARMATURE,
        )  # fmt: skip
        bodies[link.name] = body
    gripper = bodies["gripper_link"]
    gripper.add_site(name=EE_SITE, pos=EE_OFFSET, size=[0.004] * 3, group=4)
    gripper.add_geom(
        name="palm", type=mujoco.mjtGeom.mjGEOM_BOX, pos=[0.036, 0, 0], size=[0.026, 0.045, 0.022],
        group=3, mass=0, solref=PALM_SOLREF,
    )  # fmt: skip
    _add_fingers(gripper)
    _add_actuators(spec)


def _add_fingers(gripper: mujoco.MjsBody) -> None:
    for side, sign in (("left", 1.0), ("right", -1.0)):
        finger = gripper.add_body(
            name=f"{side}_finger_link", pos=FINGER_POS, gravcomp=1.0, mass=FINGER_MASS, ipos=FINGER_COM,
            inertia=FINGER_DIAGINERTIA, explicitinertial=True,
        )  # fmt: skip
        finger.add_joint(
            name=f"{side}_finger", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0], limited=True,
            range=sorted((sign * FINGER_CLOSED, sign * FINGER_OPEN)), armature=0.05,
        )  # fmt: skip
        finger.add_geom(
            name=f"{side}_pad", type=mujoco.mjtGeom.mjGEOM_BOX, size=PAD_HALF_SIZE, group=3, mass=0,
            pos=[PAD_POS[0], sign * PAD_POS[1], PAD_POS[2]], friction=[2.0, 0.02, 0.001], condim=4,
            priority=1, solimp=CONTACT_SOLIMP,
        )  # fmt: skip


def _add_actuators(spec: mujoco.MjSpec) -> None:
    for joint, limit in zip(ARM_JOINTS, ARM_FORCE_LIMIT, strict=True):
        actuator = spec.add_actuator(
            name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True,
            forcerange=[-limit, limit],
        )  # fmt: skip
        actuator.set_to_position(kp=ARM_KP, dampratio=1.0)
    gripper = spec.add_actuator(
        name="gripper", target="left_finger", trntype=mujoco.mjtTrn.mjTRN_JOINT, forcelimited=True,
        forcerange=[-GRIPPER_FORCE_LIMIT, GRIPPER_FORCE_LIMIT],
    )  # fmt: skip
    gripper.set_to_position(kp=GRIPPER_KP, dampratio=1.0)
    equality = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_JOINT, name1="right_finger", name2="left_finger",
        solimp=CONTACT_SOLIMP,
    )  # fmt: skip
    equality.data[:5] = [0, -1, 0, 0, 0]
