"""What can happen to a stream."""

from enum import IntEnum


class Intervention(IntEnum):
    """What happened to a stream right before a frame (column `cronos.intervention`).

    Ordered by strength, up to INITIAL. Where several happen at one task switch, the frame carries the strongest:
    `max(kinds)`. Every value but NONE stands on the first frame of a segment, and only there.

    TAKEOVER stands on none: it is no change of the scene but who acts after it, and a frame has to say both. It is
    counted here; the frames of a takeover are marked in a column of their own, `intervention`.
    """

    NONE = 0
    """The frame follows its predecessor by one control step."""
    TASK_SWITCH = 1
    """Only the instruction changed; the scene and the arm are as the segment before left them."""
    END_EFFECTOR_RESET = 2
    """The arm went home with the gripper open; the bodies stayed. Free."""
    HEURISTIC_RESET = 3
    """Bodies that had left the workspace were put back. Counts towards the budget."""
    SCENE_RESET = 4
    """Every body went to a benchmark configuration, the arm home. Counts towards the budget."""
    DIVERGENCE = 5
    """A scene reset that the simulation forced, because its state was no longer finite."""
    INITIAL = 6
    """The stream's very first placement. Free."""
    TAKEOVER = 7
    """An expert does the segment that begins. Counts towards the budget, at a price of its own."""


BEFORE_SEGMENTS = tuple(kind for kind in Intervention if kind not in (Intervention.NONE, Intervention.TAKEOVER))
"""What the first frame of a segment may carry."""
