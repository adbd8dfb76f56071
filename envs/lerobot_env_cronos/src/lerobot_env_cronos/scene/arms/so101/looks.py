"""Looks of the SO-101: white printed parts around dark servos, in each link's own frame.

Sizes are the bounding boxes of the printed parts and servos. Link frames are those of
`geometry`: every joint turns about the z axis of its link. Each link is one white mesh and one dark one.
"""

import mujoco
import numpy as np

from lerobot_env_cronos.scene.visuals.meshes import (
    Surface,
    add_visual,
    box,
    circle,
    cylinder,
    loft,
    merge,
    prism,
    stadium,
)

PRINT, SERVO, HORN = "white print", "servo", "servo horn"
# Sections of the jaws, from the tip to the root: height along the jaw, and lowest and highest corner across it.
FIXED_SECTIONS = (
    (-0.1044, (-0.0135, -0.0040), (-0.0079, 0.0040)),
    (-0.0944, (-0.0172, -0.0055), (-0.0086, 0.0053)),
    (-0.0844, (-0.0207, -0.0070), (-0.0104, 0.0066)),
    (-0.0648, (-0.0265, -0.0094), (-0.0122, 0.0090)),
    (-0.0451, (-0.0335, -0.0138), (-0.0136, 0.0132)),
    (-0.0300, (-0.0352, -0.0162), (-0.0150, 0.0158)),
)
MOVING_SECTIONS = (
    (-0.0810, (-0.0115, 0.0150), (-0.0060, 0.0230)),
    (-0.0720, (-0.0113, 0.0135), (-0.0025, 0.0245)),
    (-0.0620, (-0.0096, 0.0117), (0.0025, 0.0261)),
    (-0.0220, (-0.0083, 0.0106), (0.0055, 0.0272)),
    (0.0, (-0.0095, 0.0060), (0.0085, 0.0320)),
)


def dress_robot(spec: mujoco.MjSpec) -> None:
    """Draw every link of the arm and both jaws."""
    for link, parts in {
        "base": _base(),
        "shoulder": _shoulder(),
        "upper_arm": _upper_arm(),
        "lower_arm": _lower_arm(),
        "wrist": _wrist(),
        "gripper": _gripper(),
        "moving_jaw": _moving_jaw(),
    }.items():
        for material, surface in parts.items():
            add_visual(spec, spec.body(link), f"{link}/{material}", material, surface)


def _base() -> dict[str, Surface]:
    """A hexagonal foot, flat on the table, and the holder of the pan servo; the front is towards -y."""
    foot = [(-0.0347, -0.030), (-0.012, -0.0489), (0.0540, -0.0489), (0.0763, -0.030), (0.0763, 0.022),
            (0.0580, 0.0381), (-0.016, 0.0381), (-0.0347, 0.022)]  # fmt: skip
    narrow = [(0.82 * (x - 0.0208) + 0.0208, 0.86 * (y + 0.0054) - 0.0054) for x, y in foot]
    white = merge(
        prism(foot, 0.0301, 0.0440, caps="last"),
        prism(narrow, 0.0440, 0.0560, caps="last"),
        box((-0.0017, -0.0300, 0.0560), (0.0075, 0.0250, 0.0996), 0.002, "last"),
        box((0.0341, -0.0300, 0.0560), (0.0433, 0.0250, 0.0996), 0.002, "last"),
        box((-0.0017, -0.0010, 0.0560), (0.0433, 0.0429, 0.0930), 0.002, "last"),
    )
    servo = box((0.0075, -0.0333, 0.0560), (0.0341, 0.0121, 0.0964), caps="last")
    board = box((-0.0049, 0.0429, 0.0589), (0.0461, 0.0467, 0.1009))
    return {
        PRINT: white,
        SERVO: merge(servo, board),
        HORN: cylinder(0.010, 0.0964, 0.1015, pos=(0.0208, -0.0231, 0)),
    }


def _shoulder() -> dict[str, Surface]:
    """A turntable and the holder of the lift servo. The frame's z axis points down, the front is towards -x."""
    white = merge(
        prism(circle(0.023, 12), -0.0100, -0.0040, pos=(0, 0, 0)),
        box((-0.0506, -0.0264, -0.0380), (-0.0125, -0.0200, -0.0060)),
        box((-0.0506, 0.0200, -0.0380), (-0.0125, 0.0287, -0.0060)),
        box((-0.0476, -0.0230, -0.0190), (0.0122, 0.0230, -0.0060)),
    )
    servo = box((-0.0428, -0.0198, -0.0644), (-0.0180, 0.0198, -0.0190))
    horns = merge(*(cylinder(0.010, low, low + 0.003, "y", (-0.0304, 0, -0.0542)) for low in (-0.0228, 0.0198)))
    return {PRINT: white, SERVO: servo, HORN: horns}


def _cheeks(outline: np.ndarray, low: float, high: float, thickness: float) -> Surface:
    """A pair of plates parallel to the x-y plane, outer faces at z = low and high."""
    return merge(prism(outline, low, low + thickness), prism(outline, high - thickness, high))


def _upper_arm() -> dict[str, Surface]:
    """Cheeks around the lift servo, and the holder of the elbow servo at the far end."""
    lever = stadium((0.0, 0.0), (-0.1180, 0.0), 0.0120, 0.0122)
    white = merge(
        _cheeks(lever, -0.0078, 0.0445, 0.0055),
        box((-0.1302, -0.0125, -0.0030), (-0.0340, 0.0090, 0.0400)),
        box((-0.1302, -0.0200, -0.0050), (-0.0960, 0.0120, 0.0400)),
    )
    servo = box((-0.1250, -0.0382, -0.0015), (-0.1002, 0.0000, 0.0381))
    horns = merge(*(cylinder(0.010, low, low + 0.003, "z", (-0.1126, -0.0280, 0)) for low in (-0.0045, 0.0381)))
    return {PRINT: white, SERVO: servo, HORN: horns}


def _lower_arm() -> dict[str, Surface]:
    """Cheeks around the elbow servo, and the holder of the wrist servo at the far end."""
    lever = stadium((0.0, 0.0), (-0.0950, 0.0), 0.0120, 0.0115)
    white = merge(
        _cheeks(lever, -0.0078, 0.0445, 0.0055),
        box((-0.1050, -0.0090, -0.0030), (-0.0300, 0.0100, 0.0400)),
        box((-0.1187, -0.0150, -0.0082), (-0.0907, 0.0219, 0.0482)),
    )
    servo = box((-0.1451, -0.0072, -0.0015), (-0.1000, 0.0176, 0.0381))
    horns = merge(*(cylinder(0.010, low, low + 0.003, "z", (-0.1349, 0.0052, 0)) for low in (-0.0045, 0.0381)))
    return {PRINT: white, SERVO: servo, HORN: horns}


def _wrist() -> dict[str, Surface]:
    """Cheeks around the wrist servo, and the roll servo between them; the hand is towards -y."""
    lever = stadium((0.0, 0.0), (0.0, -0.0400), 0.0120, 0.0125)
    white = merge(
        _cheeks(lever, -0.0078, 0.0445, 0.0050),
        box((-0.0157, -0.0300, -0.0078), (0.0157, -0.0210, 0.0533)),
        box((-0.0157, -0.0625, -0.0078), (0.0157, -0.0210, 0.0060)),
    )
    servo = box((-0.0124, -0.0626, 0.0079), (0.0124, -0.0230, 0.0533))
    return {PRINT: white, SERVO: servo}


def _gripper() -> dict[str, Surface]:
    """The roll horn's plate, the jaw servo and the fixed jaw; the fingers point along -z."""
    white = merge(
        prism(circle(0.0200, 12), -0.0060, 0.0010),
        box((-0.0352, -0.0240, -0.0110), (0.0200, 0.0203, -0.0050)),
        box((-0.0352, -0.0240, -0.0371), (-0.0150, 0.0203, -0.0050), 0.003),
        box((-0.0200, -0.0280, -0.0371), (0.0300, -0.0193, -0.0050), 0.003),
        _jaw(FIXED_SECTIONS, (0, 1, 2)),
    )
    return {PRINT: white, SERVO: box((-0.0150, -0.0193, -0.0358), (0.0304, 0.0203, -0.0110))}


def _moving_jaw() -> dict[str, Surface]:
    """The moving jaw and its hub, around the z axis; the tip is towards -y."""
    hub = cylinder(0.0095, -0.0040, 0.0380)
    horn = cylinder(0.0075, 0.0380, 0.0429)
    return {PRINT: merge(_jaw(MOVING_SECTIONS, (0, 2, 1)), hub), HORN: horn}


def _jaw(sections: tuple, columns: tuple[int, int, int]) -> Surface:
    """A loft through rectangles; `columns` are those of the two coordinates across the jaw, and along it."""
    rings = np.zeros((len(sections), 4, 3))
    for ring, (along, (a0, b0), (a1, b1)) in zip(rings, sections, strict=True):
        ring[:, columns[0]], ring[:, columns[1]] = (a0, a1, a1, a0), (b0, b0, b1, b1)
        ring[:, columns[2]] = along
    return loft(rings)
