"""Where demonstrations begin."""

from collections.abc import Iterable
from dataclasses import dataclass

from lerobot_env_cronos import Scene, Task
from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS, sample_configuration
from lerobot_env_cronos.expert.reach import sample_reach_configuration

from cronos_lerobot.ranges import ranged

ARM_POSES = ("home", "random", "after_task", "either")
FREE_LAYOUTS = {"random": sample_configuration, "reach": sample_reach_configuration}
"""How layouts are drawn that are no configuration of the benchmark."""
LAYOUTS = ("train", *FREE_LAYOUTS)


@dataclass
class StartConfig:
    """Where a demonstration starts."""

    layouts: str = ranged("train", choices=LAYOUTS)
    """`train`: the training configurations in turn; `random`: freshly drawn in the spawn area; `reach`:
    freshly drawn wherever the arm can do the scene's tasks, at any yaw."""
    num_configurations: int = ranged(NUM_CONFIGURATIONS, minimum=1)
    """With `layouts=train`, only the first N training configurations."""
    arm_pose: str = ranged("home", choices=ARM_POSES)
    """`home`; `random`: at a random place above the table; `after_task`: where another task left it; `either`:
    in every second episode after another task where that left it, and at home in the others."""
    occupied_receptacles: bool = False
    """The target receptacle already holds another object."""
    misplaced_objects: bool = False
    """The task's object lies on another receptacle, where another task has put it. With `occupied_receptacles`
    either, with equal chances for each task that may have come before."""
    earlier_tasks: int = ranged(1, minimum=1)
    """Where a demonstration begins after another task: after 1 to N of them, with equal chances. The last one is
    as above, those before it are any others. From two on all objects may lie on receptacles, and two on one, as
    in a stream that continues without a scene reset."""
    share: float = ranged(1.0, minimum=0, maximum=1)
    """Share of the episodes that `arm_pose`, `occupied_receptacles`, `misplaced_objects` and `earlier_tasks` apply
    to; the others start at home, with every object on the table."""

    @property
    def is_after_another(self) -> bool:
        """Whether demonstrations begin where another task ended."""
        return self.occupied_receptacles or self.misplaced_objects or self.arm_pose in ("after_task", "either")


def check_starts(start: StartConfig, scene: Scene, tasks: Iterable[Task]) -> None:
    """Check that a scene has what `start` wants done before each task.

    Raises:
        ValueError: it has not.
    """
    for task in tasks:
        if (task.receptacle is None or start.is_after_another) and not tasks_before(task, scene, start):
            raise ValueError(
                f"--start: {scene.name} has no task to do before {task.instruction!r}, with"
                f" {len(scene.objects)} object(s) and {len(scene.receptacles)} receptacle(s)"
            )


def tasks_before(task: Task, scene: Scene, start: StartConfig) -> list[Task]:
    """What may be done before: another object onto the target receptacle, or the task's own onto another one.

    With neither asked for, another object onto another receptacle; before a reset task, its object onto any.
    """
    if task.receptacle is None:
        return [other for other in scene.tasks if other.object == task.object]
    # Whether the task before had the same object, and the same receptacle.
    wanted = {(False, True)} if start.occupied_receptacles else set()
    wanted |= {(True, False)} if start.misplaced_objects else set()
    return [
        other
        for other in scene.tasks
        if (other.object == task.object, other.receptacle == task.receptacle) in (wanted or {(False, False)})
    ]


def other_tasks(task: Task, scene: Scene) -> list[Task]:
    """The scene's tasks but one."""
    return [other for other in scene.tasks if other != task]
