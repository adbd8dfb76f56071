"""Scenes from outside the package: registered by name, they work wherever the built-in ones do."""

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from lerobot_env_cronos.benchmark.configurations import set_configurations_file
from lerobot_env_cronos.benchmark.version import register_gymnasium
from lerobot_env_cronos.scene.bodies import SHAPES, narrowest_width
from lerobot_env_cronos.scene.cameras import is_spawn_area_in_view
from lerobot_env_cronos.scene.model import ADD_ROBOT, TABLE
from lerobot_env_cronos.scene.scenes import BODIES, SCENES, Body, Scene
from lerobot_env_cronos.scene.visuals.objects import LOOKS

# Part of Gymnasium's environment ids and of file names.
NAME_PATTERN = re.compile(r"[a-z0-9_]+")
ROUND_SHAPES = ("disc", "plate")


def register_scene(scene: Scene, bodies: Sequence[Body] = (), configurations: Path | str | None = None) -> None:
    """Make `scene` usable by name: `CronosVectorEnv`, `--env.scene`, and `gym.make` as `gymnasium_id(scene.name)`.

    Registering the same scene again changes nothing.

    Args:
        scene: its objects and receptacles are built-in bodies or among `bodies`.
        bodies: new bodies; `Body.shape` names an entry of `bodies.SHAPES` and `visuals.objects.LOOKS`.
        configurations: JSON file written by `python -m lerobot_env_cronos.benchmark.freeze configurations`;
            without one, 64 training and 64 held-out configurations are drawn from a fixed seed in every process.
            A scene that is there keeps those it has: others are a benchmark, `files.write_benchmark`.

    Raises:
        ValueError: a name is in use, a shape or body is unknown, the gripper cannot take an object, the spawn area
            is out of reach or view, or the file cannot be used. Nothing is registered then.
    """
    new_bodies = {body.name: body for body in bodies}
    _check(scene, new_bodies)
    known = scene.name in SCENES
    added = new_bodies.keys() - BODIES.keys()
    # First: configurations are checked with the bodies that they are of.
    BODIES.update(new_bodies)
    try:
        if configurations is not None:
            set_configurations_file(scene, Path(configurations))
    except Exception:
        for name in added:
            del BODIES[name]
        raise
    SCENES[scene.name] = scene
    if not known:
        register_gymnasium(scene.name)


def _check(scene: Scene, new_bodies: dict[str, Body]) -> None:
    if not NAME_PATTERN.fullmatch(scene.name) or SCENES.get(scene.name, scene) != scene:
        raise ValueError(f"scene {scene.name!r} needs a name of a-z, 0-9 and _ that is not in {sorted(SCENES)}")
    if not scene.objects or not scene.receptacles or len(set(scene.bodies)) < len(scene.bodies):
        raise ValueError(f"a scene needs objects and receptacles, each once; {scene.name} has {scene.bodies}")
    for body in new_bodies.values():
        _check_body(body, scene.arm)
    bodies = BODIES | new_bodies
    if unknown := set(scene.bodies) - bodies.keys():
        raise ValueError(f"unknown bodies {sorted(unknown)}; valid bodies: {sorted(bodies)}")
    # Datasets name their columns so.
    if len({name.replace(" ", "_") for name in scene.bodies}) < len(scene.bodies):
        raise ValueError(f"names that differ only by a space or underscore: {scene.bodies}")
    _check_spawn_area(scene, bodies)
    for name in scene.objects:
        if (width := narrowest_width(bodies[name])) >= scene.robot.max_width_m:
            raise ValueError(
                f"the {name} is {1000 * width:.0f} mm wide where it is narrowest; the gripper takes less than "
                f"{1000 * scene.robot.max_width_m:.0f} mm"
            )


def _check_body(body: Body, arm: str) -> None:
    name, reserved, valid_shapes = body.name, _reserved_names(arm), sorted(SHAPES.keys() & LOOKS.keys())
    if BODIES.get(name, body) != body or name in reserved or not name.strip() or "/" in name:
        taken = sorted({*BODIES, *reserved})
        raise ValueError(f"a body needs a name without a slash that is not in use, got {name!r}; in use: {taken}")
    if body.shape not in valid_shapes:
        raise ValueError(f"unknown shape {body.shape!r} of the {name}; valid shapes: {valid_shapes}")
    if body.shape in ROUND_SHAPES and body.size[0] != body.size[1]:
        raise ValueError(f"a {body.shape} is round: the {name} needs two equal sides, got {body.size[:2]}")


def _check_spawn_area(scene: Scene, bodies: dict[str, Body]) -> None:
    arm, low, high = scene.robot, np.array(scene.spawn_low), np.array(scene.spawn_high)
    if not ((arm.low[:2] <= low) & (low < high) & (high <= arm.high[:2])).all():
        raise ValueError(
            f"spawn_low={scene.spawn_low} of {scene.name} must be below spawn_high={scene.spawn_high}, both in "
            f"{arm.low[:2].tolist()} to {arm.high[:2].tolist()} m"
        )
    for name in scene.bodies:
        if not is_spawn_area_in_view(scene, bodies[name]):
            raise ValueError(
                f"spawn area of {scene.name}: in a corner of {scene.spawn_low} to {scene.spawn_high} the front "
                f"camera does not see the middle of the {name}, which counts as lost; "
                f"{arm.roomy_spawn} m are in view with room for large bodies"
            )


@cache
def _reserved_names(arm: str) -> frozenset[str]:
    """Of the table and of the robot's bodies and joints: MuJoCo drops a second joint of a name without a word."""
    robot = mujoco.MjSpec()
    ADD_ROBOT[arm](robot)
    return frozenset({TABLE, *(part.name for part in (*robot.bodies, *robot.joints))})
