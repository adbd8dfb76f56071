"""Figures as small PNGs."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure
from PIL import Image

COLORS = 256
"""Of the palette: charts have few colours, and so a third of the bytes of true colour."""


def to_png(figure: Figure, dpi: float) -> bytes:
    """Draw a figure as a PNG with a palette of its own; its background is opaque."""
    drawn = BytesIO()
    figure.savefig(drawn, format="png", dpi=dpi)
    with Image.open(drawn) as image:
        small = image.convert("RGB").quantize(COLORS, dither=Image.Dither.NONE)
    packed = BytesIO()
    small.save(packed, "PNG", optimize=True)
    return packed.getvalue()
