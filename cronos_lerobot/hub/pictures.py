"""Pictures of a benchmark: its tasks, and every configuration."""

from __future__ import annotations

import io

import numpy as np
from lerobot_env_cronos import Benchmark, CronosVectorEnv
from PIL import Image, ImageDraw

from cronos_lerobot.film.sheets import PICTURE, caption_font, draw_task_sheet, encode_palette_png

ROW_PICTURE = (320, 240)
"""Width and height of a configuration's picture [px]."""
SHEET_PICTURE, SHEET_COLUMNS, SHEET_ROWS = (200, 150), 6, 2
"""Of the contact sheet, for each split."""
BATCH = 16


def render_poses(
    benchmark: Benchmark, poses: np.ndarray, size: tuple[int, int], cameras: tuple[str, ...] = ("front",)
) -> list[list[np.ndarray]]:
    """Frames (height, width, 3) uint8 of poses (n, bodies, 7) with the arm at home, one for each camera.

    `size` is (width, height) [px].
    """
    width, height = size
    env = CronosVectorEnv(
        min(BATCH, len(poses)),
        benchmark.scene.name,
        observation_height=height,
        observation_width=width,
        camera_name=",".join(cameras),
        num_threads=1,
    )
    frames: list[list[np.ndarray]] = []
    try:
        for start in range(0, len(poses), env.num_envs):
            some = poses[start : start + env.num_envs]
            ids = np.arange(len(some))
            env.place_bodies(ids, some)
            pixels = env.observe(ids)["pixels"]
            frames += [[pixels[camera][i] for camera in cameras] for i in ids]
    finally:
        env.close()
    return frames


def task_sheet(benchmark: Benchmark) -> bytes:
    """Every task from a training configuration and all cameras of the arm, as PNG."""
    tasks = [group.tasks[0] for group in benchmark.groups("independent", "train")]
    starts = benchmark.configurations["train"]
    poses = starts[np.arange(len(tasks)) % len(starts)]
    cameras = tuple(benchmark.scene.robot.cameras)
    frames = render_poses(benchmark, poses, (2 * PICTURE[0], 2 * PICTURE[1]), cameras)
    return encode_palette_png(
        draw_task_sheet([(task.instruction, shown) for task, shown in zip(tasks, frames, strict=True)])
    )


def configuration_pictures(benchmark: Benchmark) -> dict[str, list[bytes]]:
    """The front camera's view of every configuration as JPEG, by split."""
    pictures = {}
    for split, poses in benchmark.configurations.items():
        frames = render_poses(benchmark, poses, ROW_PICTURE)
        pictures[split] = [_jpeg(front) for (front,) in frames]
    return pictures


def configuration_sheet(pictures: dict[str, list[bytes]]) -> bytes:
    """The first configurations of each split side by side, as PNG."""
    width, height = SHEET_PICTURE
    gap, caption = 4, 30
    block = caption + SHEET_ROWS * (height + gap)
    sheet = Image.new("RGB", (SHEET_COLUMNS * (width + gap) + gap, len(pictures) * block + gap), "white")
    draw = ImageDraw.Draw(sheet)
    for i, (split, rows) in enumerate(pictures.items()):
        y = i * block
        text = f"{split.replace('_', '-')}: {len(rows)} configurations"
        draw.text((gap, y + caption / 2), text, font=caption_font(17), anchor="lm", fill="#222222")
        for j, row in enumerate(rows[: SHEET_COLUMNS * SHEET_ROWS]):
            picture = Image.open(io.BytesIO(row)).resize(SHEET_PICTURE, Image.Resampling.LANCZOS)
            place = (gap + j % SHEET_COLUMNS * (width + gap), y + caption + j // SHEET_COLUMNS * (height + gap))
            sheet.paste(picture, place)
    return encode_palette_png(sheet)


def _jpeg(frame: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "JPEG", quality=85)
    return buffer.getvalue()
