"""What is evaluated: the configurations of a scene, and the episodes and chains that start from them.

The package has one benchmark for each scene. Another one, with configurations and chains of its author's, is a
dataset repository on the Hub or a folder of the same layout (`lerobot_env_cronos.benchmark.files`).
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from math import perm
from typing import Any

import numpy as np

from lerobot_env_cronos.benchmark.configurations import (
    SPLITS,
    check_split,
    load_configurations,
    redraw_shared,
    sample_configurations,
)
from lerobot_env_cronos.benchmark.orderings import draw_balanced, is_training_cycle, load_orderings
from lerobot_env_cronos.benchmark.version import gymnasium_id
from lerobot_env_cronos.scene.bodies import describe_collisions
from lerobot_env_cronos.scene.scenes import BODIES, Scene, Task, get_scene

SUITES = ("independent", "sequential")
DRAWN = 7351
"""Ends the keys that a seed's benchmarks are drawn from. NumPy ignores zeros at the end of a key: without it the
first one would be the seed itself, from which the packaged configurations are drawn."""


@dataclass(frozen=True)
class EpisodeGroup:
    """Episodes of one task (independent) or chains of one ordering of tasks (sequential)."""

    number: int
    """Of the task or the ordering, within its suite and split."""
    tasks: tuple[Task, ...]
    """One after the other; a single one if independent."""
    configurations: tuple[int, ...]
    """Where the episodes start: indices into the split."""
    is_training_cycle: bool = False
    """Whether the tasks of a chain follow one another as in the training cycle, from wherever they start: streams
    of the heuristic task order have seen such chains."""

    @property
    def instructions(self) -> list[str]:
        """Of its tasks."""
        return [task.instruction for task in self.tasks]


Groups = Mapping[str, tuple[EpisodeGroup, ...]]


@dataclass(frozen=True, eq=False)
class Benchmark:
    """Configurations of one scene, and what is done from them. Every mapping is by split."""

    scene: Scene
    configurations: Mapping[str, np.ndarray]
    """Poses (n, bodies, 7): position [m], quaternion (w, x, y, z), bodies in the scene's order."""
    independent: Groups
    sequential: Groups
    source: str
    """Where it comes from: `<repository>@<commit>`, a folder, or this package with its version."""

    @property
    def tasks(self) -> tuple[Task, ...]:
        """Of the scene."""
        return self.scene.tasks

    @property
    def num_starts(self) -> dict[str, int]:
        """Configurations by split."""
        return {split: len(poses) for split, poses in self.configurations.items()}

    def groups(self, suite: str, split: str) -> tuple[EpisodeGroup, ...]:
        """The episodes of a suite on a split; a ValueError names the valid ones."""
        check_split(split)
        if suite not in SUITES:
            raise ValueError(f"unknown suite {suite!r}; valid suites: {list(SUITES)}")
        return getattr(self, suite)[split]

    def size(self, suite: str, split: str) -> int:
        """Number of episodes or chains."""
        return sum(len(group.configurations) for group in self.groups(suite, split))

    @property
    def fingerprint(self) -> str:
        """A hash of everything that decides a result: version, bodies, poses, tasks, chains; not `source`."""
        content = {
            "environment": gymnasium_id(self.scene.name),
            "bodies": describe_bodies(self.scene),
            "window_steps": self.scene.steps_per_task,
            "episodes": {
                f"{suite}/{split}": [
                    [g.number, g.instructions, g.configurations] for g in self.groups(suite, split)
                ]
                for suite in SUITES
                for split in SPLITS
            },
        }
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode())
        for split in SPLITS:
            digest.update(np.ascontiguousarray(self.configurations[split], dtype="<f8").tobytes())
        return digest.hexdigest()[:16]


def describe_bodies(scene: Scene) -> list[dict[str, Any]]:
    """Everything about the registered bodies of a scene that decides a result, as JSON holds it."""
    bodies = [BODIES[name] for name in scene.bodies]
    return json.loads(json.dumps([asdict(body) | describe_collisions(body) for body in bodies]))


def packaged_benchmark(scene_name: str) -> Benchmark:
    """The benchmark of a scene: every task, and ten orderings of them all, from all 64 configurations."""
    scene = get_scene(scene_name)
    poses = {split: load_configurations(scene_name, split) for split in SPLITS}
    source = f"lerobot_env_cronos {version('lerobot_env_cronos')}"
    return _cross(scene, poses, load_orderings(scene_name), source)


def draw_benchmark(
    scene_name: str,
    seed: int,
    num_configurations: int = 64,
    num_orderings: int = 10,
    chain_length: int | None = None,
) -> Benchmark:
    """Draw another benchmark of a scene: every task, and some chains of tasks, from new configurations.

    Args:
        scene_name: of a scene.
        seed: decides configurations and orderings; the package's own seed draws others than the package has.
        num_configurations: of each split; with more of them come new ones after the same first ones.
        num_orderings: of each split, the same in both; all different, every task as often as any other at every
            position, none a part of the training cycle while there are others.
        chain_length: tasks of a chain, all different; null for all of the scene.

    Raises:
        ValueError: there are not so many different orderings, a number is out of range, or the bodies do not fit.
    """
    scene = get_scene(scene_name)
    length = len(scene.tasks) if chain_length is None else chain_length
    if not 1 <= length <= len(scene.tasks):
        raise ValueError(f"chain_length must be 1 to {len(scene.tasks)}, the tasks of {scene_name}, got {length}")
    most = perm(len(scene.tasks), length)
    if not 1 <= num_orderings <= most:
        raise ValueError(f"num_orderings must be 1 to {most}, all of {length} tasks, got {num_orderings}")
    if num_configurations < 1 or seed < 0:
        raise ValueError(f"need a configuration and a seed >= 0, got {num_configurations} and {seed}")
    # Of its own each: from one after the other, a split would hold what another number gives the other split.
    *of_splits, of_orderings = (np.random.default_rng([seed, k, DRAWN]) for k in range(len(SPLITS) + 1))
    poses = {
        split: sample_configurations(scene, num_configurations, rng)
        for split, rng in zip(SPLITS, of_splits, strict=True)
    }
    poses["held_out"] = redraw_shared(scene, poses["held_out"], poses["train"], of_splits[1])
    drawn = draw_balanced(len(scene.tasks), length, num_orderings, of_orderings)
    orderings = [tuple(scene.tasks[i] for i in ordering) for ordering in drawn]
    return _cross(scene, poses, orderings, f"drawn with seed {seed}")


def _cross(
    scene: Scene, poses: Mapping[str, np.ndarray], orderings: Sequence[tuple[Task, ...]], source: str
) -> Benchmark:
    """Every task and every ordering from every configuration."""
    everywhere = {split: tuple(range(len(poses[split]))) for split in SPLITS}
    chains = {"independent": [(task,) for task in scene.tasks], "sequential": orderings}
    groups = {
        suite: {
            split: tuple(
                EpisodeGroup(
                    i, tuple(tasks), everywhere[split], suite == "sequential" and is_training_cycle(tasks, scene)
                )
                for i, tasks in enumerate(chains[suite])
            )
            for split in SPLITS
        }
        for suite in SUITES
    }
    return Benchmark(scene, poses, groups["independent"], groups["sequential"], source)
