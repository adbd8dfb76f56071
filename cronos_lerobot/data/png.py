"""Encodes single pictures as PNG: frames losslessly and fast, sheets of them small."""

import io
import zlib

import numpy as np
from PIL import Image


def encode_png(pixels: np.ndarray) -> bytes:
    """A uint8 (H, W, 3) RGB image as the bytes of a PNG file.

    Matching runs only (`Z_RLE`) is the fastest setting of zlib on rendered frames, and after PNG's row filters
    its files are no larger than those of the default search.
    """
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "PNG", compress_level=1, compress_type=zlib.Z_RLE)
    return buffer.getvalue()


def encode_palette_png(picture: Image.Image) -> bytes:
    """A picture for people as the bytes of a PNG file.

    256 colours show no difference in pictures as plain as these, and take a third of the space.
    """
    buffer = io.BytesIO()
    picture.quantize(256, kmeans=3, dither=Image.Dither.NONE).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()
