"""Writes what happens in a stream onto its frames."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from PIL import Image, ImageDraw

from cronos_lerobot.film.sheets import caption_font

WHITE, BAR = (255, 255, 255), (20, 22, 28, 190)
SUCCESS, FAILURE, NOTICE, PENDING = (64, 200, 110), (225, 90, 70), (255, 196, 60), (120, 124, 132)


@dataclass
class Status:
    """What the overlay says."""

    instruction: str
    segment: int
    """Number of the segment, from 0."""
    num_segments: int
    succeeded: bool
    """Whether the task has been complete at any step of the segment."""
    caption: str
    """In the bottom bar."""
    outcomes: list[bool] = field(default_factory=list)
    """Success of the segments that are over."""
    message: str = ""
    """Above the bottom bar; empty for none."""


def draw_status(frame: np.ndarray, status: Status) -> np.ndarray:
    """Return a copy of a frame (H, W, 3) uint8 with the status on it."""
    height, width = frame.shape[:2]
    unit = height / 480
    image = Image.fromarray(frame).convert("RGBA")
    layer = Image.new("RGBA", image.size)
    draw = ImageDraw.Draw(layer)
    bar, margin = round(40 * unit), round(14 * unit)
    draw.rectangle((0, 0, width, bar), fill=BAR)
    draw.rectangle((0, height - bar, width, height), fill=BAR)
    large, small = caption_font(round(19 * unit)), caption_font(round(15 * unit))
    draw.text((margin, bar / 2), status.instruction, WHITE, large, anchor="lm")
    if status.succeeded:
        _draw_check(draw, width - margin - 20 * unit, bar / 2, unit)
    draw.text((margin, height - bar / 2), status.caption, WHITE, small, anchor="lm")
    if status.message:
        place = (margin, height - bar - round(16 * unit))
        left, top, right, bottom = draw.textbbox(place, status.message, small, anchor="lm")
        pad = 6 * unit
        draw.rounded_rectangle((left - pad, top - pad, right + pad, bottom + pad), radius=pad, fill=BAR)
        draw.text(place, status.message, NOTICE, small, anchor="lm")
    _draw_outcomes(draw, status, width - margin, height - bar / 2, unit)
    return np.asarray(Image.alpha_composite(image, layer).convert("RGB"))


def _draw_check(draw: ImageDraw.ImageDraw, x: float, y: float, unit: float) -> None:
    radius = 13 * unit
    draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=SUCCESS)
    points = [(x - 6 * unit, y), (x - 1.5 * unit, y + 5 * unit), (x + 6.5 * unit, y - 5 * unit)]
    draw.line(points, fill=WHITE, width=max(1, round(3 * unit)), joint="curve")


def _draw_outcomes(draw: ImageDraw.ImageDraw, status: Status, right: float, y: float, unit: float) -> None:
    """One square for each segment: green done, red failed, grey to come."""
    step = min(18 * unit, 300 * unit / status.num_segments)
    side = 0.72 * step
    left = right - step * status.num_segments
    for i in range(status.num_segments):
        x = left + i * step
        box = (x, y - side / 2, x + side, y + side / 2)
        if i < len(status.outcomes):
            draw.rectangle(box, fill=SUCCESS if status.outcomes[i] else FAILURE)
        elif i == status.segment and status.succeeded:
            draw.rectangle(box, fill=SUCCESS)
        else:
            outline = WHITE if i == status.segment else PENDING
            draw.rectangle(box, outline=outline, width=max(1, round(1.5 * unit)))
