"""The orderings of a scene's tasks that the sequential suite evaluates: ten per scene, frozen.

The first is the training cycle, which streams of the heuristic task order run without end, from wherever they
begin. The other nine are no rotation of it, so no such stream has seen one. All ten are different, and every task
stands at every position as often as any other, so that success at a position is not success at a task.

They were drawn once by `python -m lerobot_env_cronos.benchmark.freeze orderings SCENE` from a fixed seed and are
data of this package (`data/orderings/<scene>.json`). A change of them is a new version. Scenes from outside the
package have theirs drawn from the same seed when they are first used.
"""

import json
from collections.abc import Sequence
from functools import cache
from importlib import resources
from itertools import permutations
from math import perm
from pathlib import Path

import numpy as np

from lerobot_env_cronos.scene.scenes import Scene, Task, get_scene

NUM_ORDERINGS = 10
"""Orderings of a scene; fewer where its tasks have fewer permutations."""
VERSION = 1
"""Version of the orderings."""
SEED = 2026
MAX_ATTEMPTS = 50

Ordering = tuple[Task, ...]


def is_training_cycle(tasks: Sequence[Task], scene: Scene) -> bool:
    """Whether the tasks follow one another as in the scene's training cycle, from wherever they start."""
    numbers = [scene.tasks.index(task) if task in scene.tasks else -1 for task in tasks]
    return tuple(numbers) in _windows_of_cycle(len(scene.tasks), len(tasks))


def _windows_of_cycle(num_tasks: int, length: int) -> list[tuple[int, ...]]:
    return [tuple((start + i) % num_tasks for i in range(length)) for start in range(num_tasks)]


def draw_orderings(num_tasks: int, seed: int = SEED) -> list[tuple[int, ...]]:
    """The training cycle of 0..num_tasks-1 and balanced permutations that are no rotation of it.

    They are ten together, or as many as there are. The first k are balanced as far as k can be, for every k.
    """
    number = min(NUM_ORDERINGS, 1 + perm(num_tasks) - num_tasks)
    first = tuple(range(num_tasks))
    return draw_balanced(num_tasks, num_tasks, number, np.random.default_rng(seed), (first,))


def draw_balanced(
    num_tasks: int, length: int, number: int, rng: np.random.Generator, first: tuple[tuple[int, ...], ...] = ()
) -> list[tuple[int, ...]]:
    """Draw orderings of `length` different tasks of 0..num_tasks-1, all different.

    Every task stands at every position as often as any other, give or take one, where that is possible. Those that
    follow the training cycle come last, and only if there are not enough others.

    Args:
        num_tasks: of the scene.
        length: tasks in each.
        number: orderings, those of `first` included.
        rng: draws them.
        first: the first ones.
    """
    cycle = [ordering for ordering in _windows_of_cycle(num_tasks, length) if ordering not in first]
    unseen = min(number, perm(num_tasks, length) - len(cycle))
    for _ in range(MAX_ATTEMPTS):
        drawn = list(first)
        while len(drawn) < unseen and (ordering := _draw_next(drawn, cycle, num_tasks, length, 0, rng)):
            drawn.append(ordering)
        if len(drawn) == unseen:
            break
    while len(drawn) < unseen:
        drawn.append(_draw_anyhow(drawn, cycle, num_tasks, length, rng))
    return drawn + cycle[: number - unseen]


def _draw_anyhow(
    drawn: list, taboo: list, num_tasks: int, length: int, rng: np.random.Generator
) -> tuple[int, ...]:
    """Another ordering, as balanced as can be found."""
    for slack in range(1 + len(drawn)):
        if ordering := _draw_next(drawn, taboo, num_tasks, length, slack, rng):
            return ordering
    return next(o for o in permutations(range(num_tasks), length) if o not in drawn and o not in taboo)


def _draw_next(
    drawn: list, taboo: list, num_tasks: int, length: int, slack: int, rng: np.random.Generator
) -> tuple[int, ...] | None:
    """An ordering of tasks that stand at their positions at most `slack` more often than the rarest one there."""
    counts = np.zeros((length, num_tasks), dtype=int)
    for ordering in drawn:
        counts[range(length), ordering] += 1
    allowed = [np.flatnonzero(row <= row.min() + slack) for row in counts]
    for _ in range(MAX_ATTEMPTS):
        ordering = _match([rng.permutation(tasks).tolist() for tasks in allowed])
        if ordering is not None and ordering not in drawn and ordering not in taboo:
            return ordering
    return None


def _match(allowed: list[list[int]]) -> tuple[int, ...] | None:
    """A different task for every position, out of those allowed there (Kuhn's augmenting paths)."""
    position_of: dict[int, int] = {}

    def place(position: int, tried: set[int]) -> bool:
        for task in allowed[position]:
            if task not in tried:
                tried.add(task)
                if task not in position_of or place(position_of[task], tried):
                    position_of[task] = position
                    return True
        return False

    if not all(place(position, set()) for position in range(len(allowed))):
        return None
    return tuple(sorted(position_of, key=position_of.__getitem__))


def load_orderings(scene_name: str) -> tuple[Ordering, ...]:
    """The orderings of a scene, each a permutation of `scene.tasks`; the first is `scene.tasks` itself."""
    return _load(get_scene(scene_name))


@cache
def _load(scene: Scene) -> tuple[Ordering, ...]:
    packaged = resources.files("lerobot_env_cronos").joinpath(f"data/orderings/{scene.name}.json")
    content = json.loads(packaged.read_text()) if packaged.is_file() else _generate(scene)
    return tuple(tuple(scene.tasks[i] for i in ordering) for ordering in content["orderings"])


def _generate(scene: Scene) -> dict:
    instructions = [task.instruction for task in scene.tasks]
    orderings = draw_orderings(len(instructions))
    return {
        "scene": scene.name, "version": VERSION, "seed": SEED, "tasks": instructions, "orderings": orderings
    }  # fmt: skip


def write_orderings(scene_name: str, folder: Path) -> Path:
    """Draw the orderings of a scene and write them to `folder/<scene>.json`; returns the path."""
    scene = get_scene(scene_name)
    path = folder / f"{scene.name}.json"
    path.write_text(json.dumps(_generate(scene)) + "\n")
    return path
