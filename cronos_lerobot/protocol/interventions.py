"""What can happen to a stream between two of its frames."""

from enum import IntEnum


class Intervention(IntEnum):
    """What happened to a stream right before a frame (column `cronos.intervention`).

    Ordered by strength. Where several happen at one task switch, the frame carries the strongest:
    `max(kinds)`. Every value but NONE stands on the first frame of a segment, and only there.
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
