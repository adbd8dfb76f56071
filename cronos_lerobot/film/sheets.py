"""Pictures for people as small PNGs, and sheets of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from io import BytesIO
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

PICTURE = (320, 240)
"""Width and height of a picture on a sheet [px]."""
CAPTION, GAP, COLUMNS = 34, 14, 2
STREAM_GAP = 6
COLORS = 256
"""Of the palette of a PNG: plain pictures show no difference, and take a third of the space."""


def encode_palette_png(picture: Image.Image, kmeans: int = 3) -> bytes:
    """Encode a picture with its own palette as a PNG file."""
    buffer = BytesIO()
    small = picture.quantize(COLORS, kmeans=kmeans, dither=Image.Dither.NONE)
    small.save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def to_png(figure: Figure, dpi: float) -> bytes:
    """Draw a figure as a PNG file; its background is opaque."""
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    with Image.open(drawn) as image:
        return encode_palette_png(image.convert("RGB"), kmeans=0)


@cache
def caption_font(size: int) -> ImageFont.FreeTypeFont:
    """The font of captions, which comes with matplotlib; `size` in px."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)


def draw_task_sheet(pictures: Sequence[tuple[str, Sequence[np.ndarray]]]) -> Image.Image:
    """Lay out tasks, two a row: an instruction and frames (H, W, 3) uint8, one for each camera."""
    num_cameras = len(pictures[0][1])
    cell_width, cell_height = num_cameras * PICTURE[0], CAPTION + PICTURE[1]
    rows = -(-len(pictures) // COLUMNS)
    size = (COLUMNS * (cell_width + GAP) + GAP, rows * (cell_height + GAP) + GAP)
    sheet = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(sheet)
    for i, (instruction, frames) in enumerate(pictures):
        x = GAP + i % COLUMNS * (cell_width + GAP)
        y = GAP + i // COLUMNS * (cell_height + GAP)
        draw.text((x, y + CAPTION / 2), instruction, font=caption_font(19), anchor="lm", fill="#222222")
        for j, frame in enumerate(frames):
            sheet.paste(_scaled(frame), (x + j * PICTURE[0], y + CAPTION))
    return sheet


def draw_grid(rows: Sequence[Sequence[np.ndarray]]) -> Image.Image:
    """Lay out rows of frames (H, W, 3) uint8, all rows of one length."""
    width, height = (side + STREAM_GAP for side in PICTURE)
    sheet = Image.new("RGB", (len(rows[0]) * width + STREAM_GAP, len(rows) * height + STREAM_GAP), "white")
    for i, row in enumerate(rows):
        for j, frame in enumerate(row):
            sheet.paste(_scaled(frame), (STREAM_GAP + j * width, STREAM_GAP + i * height))
    return sheet


def _scaled(frame: np.ndarray) -> Image.Image:
    return Image.fromarray(frame).resize(PICTURE, Image.Resampling.LANCZOS)
