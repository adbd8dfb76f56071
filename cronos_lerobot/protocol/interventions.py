"""What can happen to a stream."""

from enum import IntEnum


class Intervention(IntEnum):
    """What happened to a stream right before a frame (column `cronos.event`).

    Ordered by strength, up to INITIAL. Where several happen at one task switch, the frame carries the strongest.
    Every value but NONE stands on the first frame of a segment, and only there.

    HELP stands on no frame: it may begin anywhere, and changes who acts, not the scene. It is counted here; the
    frames with help are marked in a column of their own, `intervention`.
    """

    NONE = 0
    """The frame follows its predecessor by one control step."""
    TASK_SWITCH = 1
    """Only the instruction changed; the scene and the arm are as the segment before left them. Free."""
    END_EFFECTOR_RESET = 2
    """The arm went home with the gripper open; the bodies stayed. Free."""
    HEURISTIC_RESET = 3
    """Bodies that had left the workspace were put back. Counts towards the budget."""
    SCENE_RESET = 4
    """Every body went to a benchmark configuration, the arm home. Counts towards the budget."""
    DIVERGENCE = 5
    """A scene reset that the simulation forced: its state was no longer finite. Counts towards the budget."""
    INITIAL = 6
    """The stream's very first placement. Free."""
    HELP = 7
    """A person or a script begins to act in the policy's place. Counts towards the budget."""


COUNTED_INTERVENTIONS = (
    Intervention.SCENE_RESET,
    Intervention.HEURISTIC_RESET,
    Intervention.DIVERGENCE,
    Intervention.HELP,
)
"""Each of these spends 1 of the budget B."""
BEFORE_SEGMENTS = tuple(kind for kind in Intervention if kind not in (Intervention.NONE, Intervention.HELP))
"""What the first frame of a segment may carry."""
