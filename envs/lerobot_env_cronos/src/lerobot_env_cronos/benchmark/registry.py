"""Scenes from outside the package: registered by name, they work wherever the built-in ones do."""

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np

from lerobot_env_cronos.benchmark.configurations import set_configurations_file
from lerobot_env_cronos.benchmark.version import gymnasium_id
from lerobot_env_cronos.scene.bodies import SHAPES, narrowest_width
from lerobot_env_cronos.scene.model import TABLE
from lerobot_env_cronos.scene.robot import EE_HIGH, EE_LOW, add_robot
from lerobot_env_cronos.scene.scenes import BODIES, SCENES, Body, Scene
from lerobot_env_cronos.scene.view import is_spawn_area_in_view
from lerobot_env_cronos.scene.visuals.objects import FIXED_LOOKS, LOOKS

# Part of Gymnasium's environment ids and of file names.
NAME_PATTERN = re.compile(r"[a-z0-9_]+")
ROUND_SHAPES = ("disc", "plate")
MAX_WIDTH_M = 0.044
"""What the gripper takes between its fingers."""


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
        ValueError: a name is taken by something else or malformed, a shape or a body is unknown, a size, density
            or colour is none, the gripper cannot take an object, the spawn area is not within the workspace and
            the front camera's view, the file is of another scene or has a configuration that cannot be used, or
            the scene is there with other configurations. Nothing is registered then.
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
        _register_gymnasium(scene.name)


def _check(scene: Scene, new_bodies: dict[str, Body]) -> None:
    if not NAME_PATTERN.fullmatch(scene.name):
        raise ValueError(f"scene name {scene.name!r} must consist of a-z, 0-9 and _")
    if SCENES.get(scene.name, scene) != scene:
        raise ValueError(f"there is another scene {scene.name!r}; names in use: {sorted(SCENES)}")
    for body in new_bodies.values():
        _check_body(body)
    if not scene.objects or not scene.receptacles or len(set(scene.bodies)) < len(scene.bodies):
        raise ValueError(f"a scene needs objects and receptacles, each once; {scene.name} has {scene.bodies}")
    bodies = BODIES | new_bodies
    for name in scene.bodies:
        if name not in bodies:
            raise ValueError(f"unknown body {name!r}; valid bodies: {sorted(bodies)}")
    columns: dict[str, str] = {}
    for name in scene.bodies:
        if (other := columns.setdefault(name.replace(" ", "_"), name)) != name:
            raise ValueError(
                f"the bodies {other!r} and {name!r} of {scene.name} differ only by a space or underscore, and the "
                "columns of datasets would have one name: rename one of them"
            )
    _check_spawn_area(scene, bodies)
    for name in scene.objects:
        width = narrowest_width(bodies[name])
        if width >= MAX_WIDTH_M:
            raise ValueError(
                f"the {name} is an object, {1000 * width:.0f} mm wide where it is narrowest; the gripper takes "
                f"less than {1000 * MAX_WIDTH_M:.0f} mm"
            )


def _check_body(body: Body) -> None:
    name, reserved, valid_shapes = body.name, _reserved_names(), sorted(SHAPES.keys() & LOOKS.keys())
    if BODIES.get(name, body) != body:
        raise ValueError(f"there is another body {name!r}; names in use: {sorted(BODIES)}")
    if not name.strip() or "/" in name:
        raise ValueError(
            f"a body needs a name, without a slash, which parts of bodies have in theirs; got {name!r}"
        )
    if name in reserved:
        raise ValueError(f"a body cannot be named {name!r}: reserved are {sorted(reserved)}")
    if body.shape not in valid_shapes:
        raise ValueError(f"unknown shape {body.shape!r} of the {name}; valid shapes: {valid_shapes}")
    sizes = body.size if isinstance(body.size, tuple | list) else ()
    if len(sizes) != 3 or not all(map(_is_positive, (*sizes, body.density))):
        raise ValueError(
            f"size and density of the {name} must be positive and finite, three numbers [m] and one [kg/m^3], got "
            f"{body.size}, {body.density}"
        )
    if body.shape in ROUND_SHAPES and body.size[0] != body.size[1]:
        raise ValueError(f"a {body.shape} is round: the {name} needs two equal sides, got {body.size[:2]}")
    if body.colour is None:
        return
    if LOOKS[body.shape] in FIXED_LOOKS:
        coloured = [shape for shape in valid_shapes if LOOKS[shape] not in FIXED_LOOKS]
        raise ValueError(
            f"the {name} is a {body.shape}, which has colours of its own: leave colour={body.colour} out; shapes "
            f"that take one: {coloured}"
        )
    if len(body.colour) != 3 or not all(0 <= channel <= 1 for channel in body.colour):
        raise ValueError(f"colour of the {name} must be (R, G, B) in 0 to 1, got {body.colour}")


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float | np.number) and bool(0 < value < np.inf)


def _check_spawn_area(scene: Scene, bodies: dict[str, Body]) -> None:
    low, high = np.array(scene.spawn_low), np.array(scene.spawn_high)
    if not ((EE_LOW[:2] <= low) & (low < high) & (high <= EE_HIGH[:2])).all():
        raise ValueError(
            f"spawn area of {scene.name}: spawn_low={scene.spawn_low} must be below spawn_high="
            f"{scene.spawn_high}, and both in the workspace, {EE_LOW[:2].tolist()} to "
            f"{EE_HIGH[:2].tolist()} m"
        )
    for name in scene.bodies:
        if not is_spawn_area_in_view(scene, bodies[name]):
            raise ValueError(
                f"spawn area of {scene.name}: in a corner of {scene.spawn_low} to {scene.spawn_high} the front "
                f"camera would not see the middle of the {name}, which counts as lost; x 0.17 to 0.42 and y -0.15 "
                "to 0.15 m are in view with room for large bodies"
            )


@cache
def _reserved_names() -> frozenset[str]:
    """Of the table and of the robot's bodies and joints: MuJoCo drops a second joint of a name without a word."""
    robot = mujoco.MjSpec()
    add_robot(robot)
    return frozenset({TABLE, *(part.name for part in (*robot.bodies, *robot.joints))})


def register_gymnasium() -> None:
    """Register every scene of `SCENES` with Gymnasium."""
    for scene in SCENES:
        _register_gymnasium(scene)


def _register_gymnasium(scene: str) -> None:
    entry_point = "lerobot_env_cronos.episodic:CronosEnv"
    vector_entry_point = "lerobot_env_cronos.autoreset:CronosGymVectorEnv"
    gym.register(gymnasium_id(scene), entry_point, vector_entry_point=vector_entry_point, kwargs={"scene": scene})
