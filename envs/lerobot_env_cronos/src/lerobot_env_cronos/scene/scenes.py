"""The benchmark's vocabulary: objects, receptacles, tasks and scenes.

Sizes and densities are those of the SimplerEnv Bridge table and its multi-object extension RL4VLA
(Li et al. 2024, Liu et al. 2025), which the CRONOS paper builds on (Section 4). A scene is one entry of
`SCENES`; everything else (model, tasks, configurations, observations) follows from it. Scenes from outside the
package are added by `lerobot_env_cronos.benchmark.registry.register_scene`.
"""

from dataclasses import dataclass, field

from lerobot_env_cronos.scene.arms.arm import Arm
from lerobot_env_cronos.scene.arms.registry import get_arm
from lerobot_env_cronos.scene.arms.widowx.arm import WIDOWX

LONG = 1.5
"""Length over width from which on a body has two ends."""
END_SHARE = 0.8
"""Where an end is, as a share of the way from the centre to the end of the bounding box."""


@dataclass(frozen=True)
class Body:
    """A free rigid body of the scene.

    `size` is the full extent of its bounding box in its resting pose, z up [m]; `density` is that of the
    collision geometry [kg/m^3]; `shape` names a builder of `lerobot_env_cronos.scene.bodies` and a look of
    `lerobot_env_cronos.scene.visuals`; `colour` is the RGB (0 to 1) of the plain shapes `box` and `disc`.
    """

    name: str
    size: tuple[float, float, float]
    density: float
    shape: str
    colour: tuple[float, float, float] | None = None

    @property
    def keypoints(self) -> tuple[tuple[float, float, float], ...]:
        """Points in the body's frame that tell its pose [m]: its centre, and both ends if it is long."""
        width, length = sorted(self.size[:2])
        if length < LONG * width:
            return ((0.0, 0.0, 0.0),)
        end = [0.0, 0.0, 0.0]
        end[self.size.index(length)] = END_SHARE * length / 2
        x, y, z = end
        return ((0.0, 0.0, 0.0), (x, y, z), (-x, -y, -z))


@dataclass(frozen=True)
class Task:
    """One pick-and-place task; a `receptacle` of None means the table, that is a reset task."""

    object: str
    receptacle: str | None

    @property
    def instruction(self) -> str:
        """The language instruction, in the paper's wording."""
        return f"put the {self.object} on the {self.receptacle or 'table'}"


@dataclass(frozen=True)
class Scene:
    """Objects and receptacles that share one table, and the name of the arm that stands at it.

    `arm` is `widowx` or `so101`, a key of `scene.arms.registry.ARMS`. Nothing is put where it does not serve the
    spawn area.

    The reference scatters ONE object and ONE receptacle over a square of 0.15 m. A shared scene holds all of
    them without overlap, so `spawn_low` and `spawn_high` widen it to 0.20 x 0.30 m, all within reach [m]; six
    bodies need 0.25 x 0.30 m.
    """

    name: str
    objects: tuple[str, ...]
    receptacles: tuple[str, ...]
    spawn_low: tuple[float, float] = (0.20, -0.15)
    spawn_high: tuple[float, float] = (0.40, 0.15)
    # Not a part of `repr`, of which saved states have a hash.
    arm: str = field(default=WIDOWX.name, repr=False)

    def __post_init__(self) -> None:
        for name in ("objects", "receptacles", "spawn_low", "spawn_high"):
            value = getattr(self, name)
            if isinstance(value, str):
                raise ValueError(f"{name} of the scene {self.name!r} must be a tuple, ({value!r},), got {value!r}")
            # Scenes are keys of caches, which lists cannot be.
            object.__setattr__(self, name, tuple(value))
        get_arm(self.arm)

    @property
    def robot(self) -> Arm:
        """The arm that stands at the table."""
        return get_arm(self.arm)

    @property
    def fps(self) -> int:
        """Control steps a second [Hz]."""
        return self.robot.fps

    @property
    def steps_per_task(self) -> int:
        """Control steps that a task has."""
        return self.robot.steps_per_task

    @property
    def robot_type(self) -> str:
        """LeRobot's name of the arm, of datasets."""
        return self.robot.robot_type

    @property
    def bodies(self) -> tuple[str, ...]:
        """All free bodies, objects first; the order of the state vector."""
        return self.objects + self.receptacles

    @property
    def tasks(self) -> tuple[Task, ...]:
        """N x M tasks in the order of the paper's Appendix E: objects outer, receptacles inner."""
        return tuple(Task(o, r) for o in self.objects for r in self.receptacles)

    @property
    def reset_tasks(self) -> tuple[Task, ...]:
        """The learned-reset tasks "put the [object] on the table" (paper, Section 5)."""
        return tuple(Task(o, None) for o in self.objects)


BODIES: dict[str, Body] = {
    body.name: body
    for body in (
        # Long axis along y, lying on the table.
        Body("ketchup bottle", (0.0208, 0.0813, 0.0208), 500, "bottle"),
        Body("kitchen shovel", (0.0571, 0.1488, 0.0212), 557, "shovel"),
        Body("yellow plate", (0.110, 0.110, 0.006), 1003, "plate"),
        Body("cloth", (0.110, 0.110, 0.0094), 6975, "cloth"),
        # Sitting upright, facing +x, which is towards the front camera.
        Body("toy bear", (0.0426, 0.0386, 0.0564), 667, "bear"),
        Body("plastic bottle", (0.0361, 0.1216, 0.0390), 1916, "water bottle"),
        Body("carpet", (0.110, 0.0943, 0.0037), 2815, "carpet"),
        Body("newspaper", (0.0815, 0.1161, 0.0041), 2278, "newspaper"),
        # The desk of the SO-101: what its jaws hold, 8 to 45 mm wide and at least 12 mm high.
        Body("cube", (0.025, 0.025, 0.025), 900, "box", (0.86, 0.20, 0.16)),
        Body("brick", (0.030, 0.060, 0.015), 1000, "brick", (0.16, 0.45, 0.80)),
        Body("marker", (0.015, 0.120, 0.015), 900, "marker", (0.13, 0.60, 0.34)),
        Body("roll of tape", (0.040, 0.040, 0.020), 900, "tape"),
        Body("box lid", (0.105, 0.085, 0.010), 900, "lid"),
        Body("plate", (0.100, 0.100, 0.007), 1500, "dish", (0.30, 0.52, 0.86)),
        Body("mat", (0.095, 0.095, 0.004), 2500, "mat"),
    )
}

SO101_SPAWN = ((0.02, -0.28), (0.28, 0.28))
"""A box around the sector that the arm serves [m]."""

SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene("kitchen_2x2", ("ketchup bottle", "kitchen shovel"), ("yellow plate", "cloth")),
        Scene(
            "kitchen_3x3",
            ("toy bear", "kitchen shovel", "ketchup bottle"),
            ("yellow plate", "cloth", "carpet"),
            spawn_low=(0.17, -0.15),
            spawn_high=(0.42, 0.15),
        ),
        Scene("playroom_2x2", ("toy bear", "plastic bottle"), ("newspaper", "carpet")),
        Scene("so101_desk_2x2", ("cube", "marker"), ("box lid", "plate"), *SO101_SPAWN, arm="so101"),
        Scene(
            "so101_desk_3x3",
            ("brick", "marker", "roll of tape"),
            ("box lid", "plate", "mat"),
            *SO101_SPAWN,
            arm="so101",
        ),
    )
}


def get_scene(name: str) -> Scene:
    """Look a scene up by name; a ValueError names the valid ones."""
    if name not in SCENES:
        raise ValueError(
            f"unknown scene {name!r}; valid scenes: {sorted(SCENES)}. One of your own is registered by its "
            "package: install it as lerobot_env_<name>, or give --env.discover_packages_path=<package>"
        )
    return SCENES[name]
