"""Draws every task of a scene, one picture each with its instruction and both cameras, onto one sheet.

python -m cronos_lerobot.film.task_pictures --scene=kitchen_2x2
"""

from __future__ import annotations

import argparse
from importlib import import_module
from pathlib import Path

import numpy as np
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.scene.scenes import get_scene
from lerobot_env_cronos.simulation.rendering import RENDERERS

from cronos_lerobot.film.sheets import PICTURE, draw_task_sheet, encode_palette_png

CAMERAS = ("front", "bridge")


def render_tasks(
    scene: str, split: str = "train", renderer: str = "classic"
) -> list[tuple[str, list[np.ndarray]]]:
    """Return (instruction, one frame (480, 640, 3) uint8 per camera) of every task's start.

    Task i is shown from configuration i of the split, so that the sheet also shows how scenes differ.
    """
    tasks = get_scene(scene).tasks
    width, height = 2 * PICTURE[0], 2 * PICTURE[1]
    env = CronosVectorEnv(
        len(tasks), scene, observation_height=height, observation_width=width, camera_name=",".join(CAMERAS),
        renderer=renderer,
    )  # fmt: skip
    try:
        everyone = np.arange(len(tasks))
        env.scene_reset(everyone, everyone, split)
        env.set_task(everyone, tasks)
        pixels = env.observe()["pixels"]
        return [(task.instruction, [pixels[camera][i] for camera in CAMERAS]) for i, task in enumerate(tasks)]
    finally:
        env.close()


def main() -> None:
    """Write the sheet of a scene."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scene", default="kitchen_2x2", help="default: kitchen_2x2")
    parser.add_argument("--import", metavar="MODULE", dest="module", help="register the scenes of a module first")
    parser.add_argument("--split", default="train", choices=("train", "held_out"))
    parser.add_argument("--renderer", default="classic", choices=RENDERERS)
    parser.add_argument("--output", type=Path, help="default: docs/images/tasks_SCENE.png")
    args = parser.parse_args()
    register_third_party_plugins()
    try:
        if args.module:
            import_module(args.module)
        get_scene(args.scene)
    except (ValueError, ModuleNotFoundError) as error:
        parser.error(str(error))
    output = args.output or Path("docs/images") / f"tasks_{args.scene}.png"
    output.parent.mkdir(parents=True, exist_ok=True)
    output.write_bytes(encode_palette_png(draw_task_sheet(render_tasks(args.scene, args.split, args.renderer))))
    print(output)


if __name__ == "__main__":
    main()
