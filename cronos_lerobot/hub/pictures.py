"""Pictures of a benchmark: its tasks, and every configuration."""

from __future__ import annotations

import io

import numpy as np
from lerobot_env_cronos import Benchmark
from PIL import Image, ImageDraw

from cronos_lerobot.film.sheets import PICTURE, caption_font, draw_task_sheet, encode_palette_png
from cronos_lerobot.film.starts import render_poses

ROW_PICTURE = (320, 240)
"""Width and height of a configuration's picture [px]."""
SHEET_PICTURE, SHEET_COLUMNS, SHEET_ROWS = (200, 150), 6, 2
"""Of the contact sheet, for each split."""


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
