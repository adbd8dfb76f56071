"""Pictures for people as small PNGs."""

from __future__ import annotations

from io import BytesIO

from matplotlib.figure import Figure
from PIL import Image

COLORS = 256
"""Of the palette: plain pictures show no difference, and take a third of the space."""


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
