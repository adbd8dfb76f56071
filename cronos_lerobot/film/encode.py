"""Frames to MP4 and GIF."""

from pathlib import Path

import numpy as np
from lerobot.configs import RGBEncoderConfig
from PIL import Image

from cronos_lerobot.data.video import VideoFile

GIF_SIZE = (320, 240)
GIF_FPS = 10
MAX_GIF_BYTES = 1_500_000
GIF_QUALITIES = ((2, 128), (2, 64), (3, 64), (4, 48), (6, 32), (8, 32), (12, 24))
"""(every how many-th control step, colours), tried in this order until the file is small enough."""


def write_mp4(path: Path, frames: list[np.ndarray], fps: int) -> None:
    """Encode frames (H, W, 3) uint8 as h264 that every browser plays; a kill leaves no half of it at `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    encoder = RGBEncoderConfig(vcodec="h264", preset="medium", g=10 * fps, crf=28)
    partial = path.with_name(f".{path.name}")
    with VideoFile(partial, fps, *frames[0].shape[:2], encoder) as video:
        video.append(np.stack(frames))
    partial.replace(path)


def write_gif(path: Path, frames: list[np.ndarray], max_bytes: int = MAX_GIF_BYTES) -> int:
    """Write a sped-up GIF of at most `max_bytes`, if the coarsest setting allows; returns its size [bytes]."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for stride, colors in GIF_QUALITIES:
        images = [Image.fromarray(frame).resize(GIF_SIZE, Image.Resampling.LANCZOS) for frame in frames[::stride]]
        # One palette for all frames, and no dithering, so that what stands still costs nothing.
        sheet = Image.new("RGB", (GIF_SIZE[0], GIF_SIZE[1] * 8))
        for i, number in enumerate(np.linspace(0, len(images) - 1, 8).astype(int)):
            sheet.paste(images[number], (0, i * GIF_SIZE[1]))
        palette = sheet.quantize(colors, method=Image.Quantize.MEDIANCUT)
        small = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
        small[0].save(
            path, save_all=True, append_images=small[1:], duration=1000 // GIF_FPS, loop=0, optimize=True
        )
        if path.stat().st_size <= max_bytes:
            break
    return path.stat().st_size
