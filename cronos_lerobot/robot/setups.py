"""What stands around a robot: tasks, starts, home pose and limits, from a file or from a CRONOS scene."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.scene.arms.arm import Arm
from lerobot_env_cronos.scene.arms.registry import ARMS
from lerobot_env_cronos.scene.scenes import get_scene
from lerobot_env_cronos.simulation.observations import agent_pos_names, one_hot
from PIL import Image

SPLITS = ("train", "held_out")
PICTURES = (".jpg", ".jpeg", ".png")
KEYS = ("name", "tasks", "starts", "arm", "home", "low", "high", "box")


@dataclass(frozen=True)
class RobotTask:
    """What the robot is told to do."""

    instruction: str


@dataclass(frozen=True)
class Setup:
    """A robot's tasks and starts, and where it may move."""

    name: str
    tasks: tuple[Any, ...]
    starts: Mapping[str, int]
    """How many, by split."""
    picture: Callable[[str, int], Image.Image]
    """Of a split's start: where a person puts the objects."""
    fingerprint: str
    home: np.ndarray
    """(A,) an action, the pose at rest."""
    low: np.ndarray
    high: np.ndarray
    """(A,) limits of an action."""
    task_names: tuple[str, ...]
    tell: Callable[[Any], np.ndarray]
    """A task as numbers (len(task_names),) float32, for policies that read no instructions."""
    action_names: tuple[str, ...] | None = None
    """Of the arm that home and limits are of; None if they were given."""
    reset_tasks: tuple[Any, ...] = ()
    hand: Callable[[np.ndarray], np.ndarray] | None = None
    """Where the hand is under an action (A,), (3,) in the base frame [m]; None if nobody knows."""
    box: np.ndarray | None = None
    """(2, 3) corners of the box that the hand stays in [m]; None is no box."""


def load_setup(source: str) -> Setup:
    """Read a file of tasks, or take those of a scene.

    Args:
        source: path of a YAML file, or the name of a scene: `so101_desk_2x2`.

    Raises:
        ValueError: there is no such file or scene, or the file lacks something.
    """
    path = Path(source)
    if path.suffix not in (".yaml", ".yml"):
        return _of_scene(source)
    if not path.is_file():
        raise ValueError(f"--env.tasks={source}: there is no such file")
    said = yaml.safe_load(path.read_text())
    if not isinstance(said, dict) or not {"tasks", "starts"} <= said.keys() <= set(KEYS):
        raise ValueError(f"--env.tasks={source} must have tasks and starts, and may have {list(KEYS)}")
    return _of_file(path, said)


def _of_file(path: Path, said: dict[str, Any]) -> Setup:
    arm = said.get("arm")
    if arm is not None and arm not in ARMS:
        raise ValueError(f"{path}: unknown arm {arm!r}; valid arms: {sorted(ARMS)}")
    known = _of_arm(ARMS[arm]) if arm else {}
    known |= {key: np.array(said[key], dtype=np.float32) for key in ("home", "low", "high") if key in said}
    if missing := {"home", "low", "high"} - known.keys():
        raise ValueError(f"{path} needs {sorted(missing)}, one number for each of an action, or arm: so101")
    box = said.get("box")
    if box is not None and "hand" not in known:
        raise ValueError(f"{path}: box needs an arm whose kinematics are known; valid arms: {sorted(ARMS)}")
    photos = {split: _photos(path.parent / folder) for split, folder in said["starts"].items()}
    tasks = tuple(RobotTask(str(text)) for text in said["tasks"])
    digest = hashlib.sha256("\n".join(task.instruction for task in tasks).encode())
    for split in SPLITS:
        for photo in photos.get(split, []):
            digest.update(photo.read_bytes())
    return Setup(
        name=str(said.get("name", path.stem)),
        tasks=tasks,
        starts={split: len(photos.get(split, [])) for split in SPLITS},
        picture=lambda split, number: Image.open(photos[split][number]),
        fingerprint=digest.hexdigest(),
        task_names=tuple(f"task.{task.instruction.replace(' ', '_')}" for task in tasks),
        tell=lambda task: np.eye(len(tasks), dtype=np.float32)[tasks.index(task)],
        box=None if box is None else np.array(box, dtype=float).reshape(2, 3),
        **known,
    )


def _photos(folder: Path) -> list[Path]:
    photos = sorted(file for file in folder.glob("*") if file.suffix.lower() in PICTURES)
    if not photos:
        raise ValueError(f"{folder} has no picture of a start; valid kinds: {list(PICTURES)}")
    return photos


def _of_scene(name: str) -> Setup:
    scene = get_scene(name)
    world = CronosVectorEnv(1, name, obs_type="environment_state_agent_pos")

    def picture(split: str, number: int) -> Image.Image:
        world.scene_reset(np.array([0]), np.array([number]), split)
        return Image.fromarray(world.render_streams(np.array([0]))[0])

    return Setup(
        name=name,
        tasks=tuple(scene.tasks),
        reset_tasks=tuple(scene.reset_tasks),
        starts=world.num_starts,
        picture=picture,
        fingerprint=world.identity.fingerprint,
        task_names=agent_pos_names(scene, "one_hot")[len(scene.robot.state_names) :],
        tell=lambda task: one_hot(scene, [task])[0],
        **_of_arm(scene.robot),
    )


def _of_arm(arm: Arm) -> dict[str, Any]:
    def hand(action: np.ndarray) -> np.ndarray:
        joints, _ = arm.next_target(arm.home_qpos[None, : arm.num_joints], action[None], arm.forward_kinematics)
        return arm.forward_kinematics(joints)[0][0]

    home = arm.hold(arm.home_qpos[None, : arm.num_joints])[0]
    return {
        "home": home.astype(np.float32),
        "low": arm.action_low.astype(np.float32),
        "high": arm.action_high.astype(np.float32),
        "hand": hand,
        "action_names": arm.action_names,
    }
