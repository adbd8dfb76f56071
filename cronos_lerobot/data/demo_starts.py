"""Where demonstrations begin."""

from collections.abc import Iterable
from dataclasses import dataclass

from lerobot_env_cronos import Scene, Task
from lerobot_env_cronos.benchmark.configurations import NUM_CONFIGURATIONS, sample_configuration
from lerobot_env_cronos.expert.reach import sample_reach_configuration

ARM_POSES = ("home", "random", "after_task", "either")
FREE_LAYOUTS = {"random": sample_configuration, "reach": sample_reach_configuration}
"""How layouts are drawn that are no configuration of the benchmark."""
LAYOUTS = ("train", *FREE_LAYOUTS)


@dataclass
class StartConfig:
    """Where a demonstration starts."""

    layouts: str = "train"
    """`train`: the training configurations in turn; `random`: freshly drawn in the spawn area; `reach`:
    freshly drawn wherever the arm can do the scene's tasks, at any yaw."""
    num_configurations: int = NUM_CONFIGURATIONS
    """Of the training configurations the first so many; a policy cloned from one has only ever seen that one. A
    scene's own are 64, and a benchmark has as many as it was made with."""
    arm_pose: str = "home"
    """`home`; `random`: at a random place above the table; `after_task`: where another task left it; `either`:
    in every second episode after another task where that left it, and at home in the others."""
    occupied_receptacles: bool = False
    """The target receptacle already holds another object."""
    misplaced_objects: bool = False
    """The task's object lies on another receptacle, where another task has put it; beside `occupied_receptacles`
    it is either, with equal chances for each task that may have come before."""
    earlier_tasks: int = 1
    """Where a demonstration begins after another task, how many may have been done: one to so many, with equal
    chances, the last of them as above and those before it any others. From two on all objects may lie on
    receptacles, and two on one, as in a stream that goes on without a scene reset."""
    policy: str | None = None
    """Checkpoint or Hub id of a policy that does the earlier tasks in place of the expert: one to `earlier_tasks`
    of any, each for `max_steps`, whether it succeeds or not. Demonstrations then begin where its own streams get
    stuck (as in DAgger, Ross et al. 2011, an expert for the states of the learner)."""
    leaning_share: float = 0.0
    """Share of the layouts in which one object has fallen over the edge of another body, from 0 to 1."""
    share: float = 1.0
    """Share of the episodes that `arm_pose`, `occupied_receptacles`, `misplaced_objects`, `earlier_tasks` and
    `policy` apply to; the others start at home, with every object on the table."""

    def __post_init__(self) -> None:
        """Check the choices."""
        if self.layouts not in LAYOUTS:
            raise ValueError(f"unknown start.layouts {self.layouts!r}; valid: {list(LAYOUTS)}")
        if self.arm_pose not in ARM_POSES:
            raise ValueError(f"unknown start.arm_pose {self.arm_pose!r}; valid: {list(ARM_POSES)}")
        if self.num_configurations < 1:
            raise ValueError(f"start.num_configurations must be at least 1, got {self.num_configurations}")
        if self.layouts != "train" and self.num_configurations != NUM_CONFIGURATIONS:
            raise ValueError(
                f"start.num_configurations={self.num_configurations} is of start.layouts=train, got"
                f" start.layouts={self.layouts}, which draws others without end"
            )
        if self.earlier_tasks < 1:
            raise ValueError(f"start.earlier_tasks must be at least 1, got {self.earlier_tasks}")
        if self.earlier_tasks > 1 and not self.is_after_another:
            raise ValueError(
                f"start.earlier_tasks={self.earlier_tasks} needs start.occupied_receptacles,"
                " start.misplaced_objects, start.arm_pose=after_task (or either) or start.policy: without them"
                " nothing was done before"
            )
        if self.policy and (self.occupied_receptacles or self.misplaced_objects):
            raise ValueError(
                "start.policy does any tasks before: start.occupied_receptacles and start.misplaced_objects say"
                " which ones the expert does"
            )
        for name in ("share", "leaning_share"):
            if not 0 <= (value := getattr(self, name)) <= 1:
                raise ValueError(f"start.{name} must be between 0 and 1, got {value}")

    @property
    def is_after_another(self) -> bool:
        """Whether demonstrations begin where another task ended."""
        after_task = self.arm_pose in ("after_task", "either")
        return self.occupied_receptacles or self.misplaced_objects or after_task or bool(self.policy)


def check_starts(start: StartConfig, scene: Scene, tasks: Iterable[Task], available: int) -> None:
    """Check that a scene has what `start` wants done before each task, and so many configurations.

    Args:
        start: what is wanted.
        scene: of the demonstrations.
        tasks: to demonstrate.
        available: training configurations that there are.

    Raises:
        ValueError: it has not.
    """
    # With the default a smaller benchmark gives all that it has.
    if start.num_configurations > max(available, NUM_CONFIGURATIONS):
        raise ValueError(
            f"--start.num_configurations={start.num_configurations}, but there are {available} training"
            f" configurations: give {available} or fewer"
        )
    for task in tasks:
        if (task.receptacle is None or start.is_after_another) and not tasks_before(task, scene, start):
            raise ValueError(
                f"nothing can be done before {task.instruction!r} in {scene.name}, which has {len(scene.objects)} "
                f"object(s) and {len(scene.receptacles)} receptacle(s), as --start.arm_pose={start.arm_pose}, "
                f"--start.occupied_receptacles={str(start.occupied_receptacles).lower()} and "
                f"--start.misplaced_objects={str(start.misplaced_objects).lower()} ask"
            )


def tasks_before(task: Task, scene: Scene, start: StartConfig) -> list[Task]:
    """What may be done before: another object onto the target receptacle, or the task's own onto another one.

    With neither asked for, another object onto another receptacle; before a reset task, its object onto any. A
    policy does any other task.
    """
    if task.receptacle is None:
        return [other for other in scene.tasks if other.object == task.object]
    if start.policy is not None:
        return other_tasks(task, scene)
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
