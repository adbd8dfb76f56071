"""Frames to MP4."""

from pathlib import Path

import numpy as np
from lerobot.configs import RGBEncoderConfig

from cronos_lerobot.data.video import VideoFile


def write_mp4(path: Path, frames: list[np.ndarray], fps: int) -> None:
    """Encode frames (H, W, 3) uint8 as h264 that every browser plays; a kill leaves no half of it at `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    encoder = RGBEncoderConfig(vcodec="h264", preset="medium", g=10 * fps, crf=28)
    partial = path.with_name(f".{path.name}")
    with VideoFile(partial, fps, *frames[0].shape[:2], encoder) as video:
        video.append(np.stack(frames))
    partial.replace(path)
