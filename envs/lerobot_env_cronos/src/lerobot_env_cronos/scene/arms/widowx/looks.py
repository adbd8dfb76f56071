"""Looks of the WidowX-250S: black links around Dynamixel servos, in each link's own frame.

Link axes at the zero pose: x forward, y left, z up; every joint frame is that of `geometry`.
Each link is one dark mesh, one of a lighter black that sets plates apart from servos, and a few metal accents.
"""

import mujoco

from lerobot_env_cronos.scene.arms.widowx.geometry import FINGER_POS, PAD_HALF_SIZE, PAD_POS
from lerobot_env_cronos.scene.visuals.meshes import (
    Surface,
    add_visual,
    box,
    circle,
    cylinder,
    merge,
    prism,
    rectangle,
    stadium,
)

FINGER_END = PAD_POS[0] + PAD_HALF_SIZE[0]


def dress_robot(spec: mujoco.MjSpec) -> None:
    """Draw every link of the arm and both fingers."""
    for link, parts in {
        "base_link": _base(),
        "shoulder_link": _shoulder(),
        "upper_arm_link": _upper_arm(),
        "upper_forearm_link": _upper_forearm(),
        "lower_forearm_link": _lower_forearm(),
        "wrist_link": _wrist(),
        "gripper_link": _gripper(),
        "left_finger_link": _finger(1.0),
        "right_finger_link": _finger(-1.0),
    }.items():
        for material, surface in parts.items():
            add_visual(spec, spec.body(link), f"{link}/{material}", material, surface)


def _horns(x: float, z: float, y: float, radius: float = 0.011) -> Surface:
    """Metal servo horns about the y axis, on both outer faces at +-y."""
    return merge(
        cylinder(radius, y, y + 0.002, "y", (x, 0, z), 8, "last"),
        cylinder(radius, -y - 0.002, -y, "y", (x, 0, z), 8, "first"),
    )


def _plates(outline, y: float, thickness: float) -> Surface:
    """A pair of plates parallel to the x-z plane, outer faces at +-y."""
    return merge(prism(outline, y - thickness, y, "y"), prism(outline, -y, -y + thickness, "y"))


def _base() -> dict[str, Surface]:
    plate = prism([(-0.115, -0.045), (-0.095, -0.066), (0.03, -0.066), (0.062, -0.04), (0.062, 0.04),
                   (0.03, 0.066), (-0.095, 0.066), (-0.115, 0.045)], 0.0, 0.010, caps="last")  # fmt: skip
    housing = box((-0.105, -0.045, 0.010), (-0.028, 0.045, 0.046), 0.006, "last")
    servo = box((-0.030, -0.034, 0.010), (0.040, 0.034, 0.052), 0.005, "last")
    turntable = cylinder(0.045, 0.052, 0.066, sides=16, caps="last")
    return {"arm": merge(housing, servo, turntable), "arm edge": plate}


def _shoulder() -> dict[str, Surface]:
    axis = 0.03865
    disc = cylinder(0.042, -0.006, 0.008, sides=16, caps="last")
    servos = [box((-0.024, y - 0.017, 0.008), (0.024, y + 0.017, 0.060), 0.004, "last") for y in (-0.020, 0.020)]
    return {"arm": merge(disc, *servos), "metal": _horns(0.0, axis, 0.044, 0.012)}


def _upper_arm() -> dict[str, Surface]:
    lever = stadium((0.0, 0.0), (0.0, 0.245), 0.024, 0.021)
    elbow = stadium((0.0, 0.247), (0.04975, 0.25), 0.019, 0.021)
    spine = box((-0.014, -0.030, 0.05), (0.012, 0.030, 0.185), 0.004)
    head = box((-0.016, -0.038, 0.215), (0.022, 0.038, 0.262))
    return {
        "arm edge": merge(_plates(lever, 0.0435, 0.006), _plates(elbow, 0.0435, 0.006)),
        "arm": merge(spine, head),
        "metal": _horns(0.04975, 0.25, 0.0435),
    }


def _upper_forearm() -> dict[str, Surface]:
    servo = box((-0.020, -0.030, -0.0185), (0.040, 0.030, 0.0185), 0.003)
    tube = prism(rectangle(0.017, 0.0155, 0.005), 0.038, 0.138, "x", "none")
    roll_servo = prism(rectangle(0.024, 0.019, 0.004), 0.128, 0.175, "x")
    collar = prism(circle(0.023, 12), 0.110, 0.127, "x")
    return {"arm": merge(servo, tube, roll_servo, collar)}


def _lower_forearm() -> dict[str, Surface]:
    disc = prism(circle(0.021, 12), 0.0, 0.010, "x", "none")
    yoke = prism(rectangle(0.0285, 0.018, 0.004), 0.010, 0.030, "x")
    cheeks = _plates(stadium((0.024, 0.0), (0.075, 0.0), 0.017, 0.0165), 0.0285, 0.005)
    return {"metal": merge(disc, _horns(0.075, 0.0, 0.0285, 0.010)), "arm edge": merge(yoke, cheeks)}


def _wrist() -> dict[str, Surface]:
    servo = box((-0.016, -0.023, -0.017), (0.036, 0.023, 0.017), 0.003)
    rotate = prism(rectangle(0.018, 0.022, 0.004), 0.030, 0.056, "x", pos=(0, 0, 0.006))
    return {"arm": merge(servo, rotate), "metal": prism(circle(0.016, 10), 0.056, 0.0645, "x", "none")}


def _gripper() -> dict[str, Surface]:
    horn = prism(circle(0.019, 10), 0.0, 0.010, "x", "first")
    servo = prism(rectangle(0.030, 0.022, 0.004), 0.008, 0.050, "x")
    # The rail that both finger carriages slide on.
    rail = prism(rectangle(0.066, 0.013, 0.004), 0.046, 0.060, "x")
    ends = [cylinder(0.006, 0.0445, 0.0460, "x", (0, y, 0), 6, "first") for y in (-0.057, 0.057)]
    return {"arm": merge(horn, servo), "arm edge": rail, "metal": merge(*ends)}


def _finger(side: float) -> dict[str, Surface]:
    """A carriage on the rail and a finger that tapers to the pad; `side` is +1 for the left finger."""
    base = 0.062 - FINGER_POS[0]
    inner, outer = PAD_POS[1] - PAD_HALF_SIZE[1], PAD_POS[1] + PAD_HALF_SIZE[1]
    pad_start = PAD_POS[0] - PAD_HALF_SIZE[0]
    hz = PAD_HALF_SIZE[2]

    def mirrored(outline):
        return [(x, side * y) for x, y in outline]

    carriage = prism(mirrored([(base, -0.010), (base + 0.014, -0.010), (base + 0.014, 0.016), (base, 0.016)]),
                     -0.016, 0.016)  # fmt: skip
    shank = prism(mirrored([(base + 0.013, -0.008), (base + 0.013, 0.012), (pad_start, 0.008),
                            (pad_start, outer - 0.004)]), -0.012, 0.012)  # fmt: skip
    tip = prism(mirrored([(pad_start, outer - 0.004), (pad_start, 0.008), (FINGER_END, outer + 0.002),
                          (FINGER_END, outer - 0.002)]), -hz + 0.001, hz - 0.001)  # fmt: skip
    pad = prism(mirrored([(pad_start, inner), (FINGER_END, inner), (FINGER_END, outer - 0.002),
                          (pad_start, outer - 0.002)]), -hz, hz)  # fmt: skip
    return {"arm": merge(carriage, shank, tip), "pad": pad}
