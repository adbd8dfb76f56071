"""The orderings of a scene's tasks that the sequential suite evaluates: ten per scene, frozen.

The first is the training cycle; the other nine were drawn once by
`python -m lerobot_env_cronos.benchmark.orderings SCENE` from a fixed seed and are data of this package
(`data/orderings/<scene>.json`). A change of them is a new version. Scenes from outside the package have theirs
drawn from the same seed when they are first used.
"""

import argparse
import json
from functools import cache
from importlib import resources
from math import factorial
from pathlib import Path

import numpy as np

from lerobot_env_cronos.scene.scenes import Scene, Task, get_scene

NUM_ORDERINGS = 10
"""Orderings of a scene; fewer where its tasks have fewer permutations."""
VERSION = 0
"""Version of the orderings."""
SEED = 2026

Ordering = tuple[Task, ...]


def draw_orderings(num_tasks: int, seed: int = SEED) -> list[list[int]]:
    """Draw distinct permutations of 0..num_tasks-1, the first one unpermuted; ten, or all that there are."""
    rng = np.random.default_rng(seed)
    orderings = [list(range(num_tasks))]
    while len(orderings) < min(NUM_ORDERINGS, factorial(num_tasks)):
        drawn = rng.permutation(num_tasks).tolist()
        if drawn not in orderings:
            orderings.append(drawn)
    return orderings


def load_orderings(scene_name: str) -> tuple[Ordering, ...]:
    """The orderings of a scene, each a permutation of `scene.tasks`; the first is `scene.tasks` itself.

    Raises:
        ValueError: unknown scene, or the packaged file is of other tasks.
    """
    return _load(get_scene(scene_name))


@cache
def _load(scene: Scene) -> tuple[Ordering, ...]:
    packaged = resources.files("lerobot_env_cronos").joinpath(f"data/orderings/{scene.name}.json")
    content = json.loads(packaged.read_text()) if packaged.is_file() else _generate(scene)
    instructions = [task.instruction for task in scene.tasks]
    if content["tasks"] != instructions or content["version"] != VERSION:
        found = f"v{content['version']} of {content['tasks']}"
        raise ValueError(f"{packaged} is {found}; {scene.name} needs v{VERSION} of {instructions}")
    return tuple(tuple(scene.tasks[i] for i in ordering) for ordering in content["orderings"])


def _generate(scene: Scene) -> dict:
    instructions = [task.instruction for task in scene.tasks]
    orderings = draw_orderings(len(instructions))
    return {
        "scene": scene.name, "version": VERSION, "seed": SEED, "tasks": instructions, "orderings": orderings
    }  # fmt: skip


def main() -> None:
    """Write the orderings of a scene; for maintainers, when a new version is made."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("scene")
    parser.add_argument("--output", type=Path, default=Path("."), help="folder")
    args = parser.parse_args()
    path = args.output / f"{args.scene}.json"
    path.write_text(json.dumps(_generate(get_scene(args.scene))) + "\n")
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
