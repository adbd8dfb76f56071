"""Camera images as the two vision towers want them."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from lerobot_policy_openvla.architecture import Architecture

CROP_AREA = 0.9
"""Part of the image that the centre crop keeps: checkpoints trained on random crops of it are evaluated so."""


def centre_crop(images: Tensor, area: float = CROP_AREA) -> Tensor:
    """Cut the middle out of images (..., H, W): `area` of the whole, with the same aspect ratio."""
    height, width = images.shape[-2:]
    rows, columns = (round(side * math.sqrt(area)) for side in (height, width))
    top, left = (height - rows) // 2, (width - columns) // 2
    return images[..., top : top + rows, left : left + columns]


def resize(images: Tensor, size: int) -> Tensor:
    """Bicubic resize of images (B, 3, H, W) in 0..255 to (B, 3, size, size), without regard to the aspect ratio.

    The levels are what PIL makes of them, with which the published checkpoints were trained: along rows first,
    then along columns, and each time rounded to whole levels.
    """
    for shape in ((images.shape[-2], size), (size, size)):
        images = interpolate(images.float(), size=shape, mode="bicubic", antialias=True)
        # Halves up: with whole sizes on both sides they are frequent.
        images = (images + 0.5).floor().clamp(0, 255)
    return images


def prepare_images(images: Tensor, architecture: Architecture, crop: bool) -> Tensor:
    """Turn images (B, 3, H, W) into pixel values (B, 6, size, size), float32.

    Args:
        images: uint8, or floats in [0, 1].
        architecture: tells the size and the normalisation of each tower.
        crop: keep the middle only, see `centre_crop`.

    Raises:
        ValueError: the shape is another one.
    """
    if images.ndim != 4 or images.shape[1] != 3:
        raise ValueError(f"Images must be (B, 3, height, width), got {tuple(images.shape)}.")
    levels = images if images.dtype == torch.uint8 else images.float() * 255
    pixels = resize(centre_crop(levels) if crop else levels, architecture.image_size) / 255
    towers = []
    for mean, std in zip(architecture.image_means, architecture.image_stds, strict=True):
        shift, scale = (torch.tensor(v, device=pixels.device).view(3, 1, 1) for v in (mean, std))
        towers.append((pixels - shift) / scale)
    return torch.cat(towers, dim=1)
