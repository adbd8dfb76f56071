"""Camera images as the two vision towers want them."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from lerobot_policy_openvla.architecture import Architecture

CROP_AREA = 0.9
"""Part of the image that the centre crop keeps: checkpoints trained on random crops of it are evaluated so."""


def centre_crop(images: Tensor, size: int, area: float = CROP_AREA) -> Tensor:
    """Cut the middle out of images (B, 3, H, W) in 0..255 and resize it to (B, 3, size, size).

    Both in one, as in the published evaluation (TensorFlow's `crop_and_resize`): bilinear without antialiasing,
    the outermost pixels of the result on the edges of the crop, whose sides are sqrt(area) of the image's as
    distances between the centres of its outermost pixels.
    """
    edge = math.sqrt(area)
    points = torch.linspace(-edge, edge, size, device=images.device)
    grid = torch.stack(torch.meshgrid(points, points, indexing="xy"), dim=-1)
    grid = grid.expand(len(images), -1, -1, -1)
    cropped = grid_sample(images.float() / 255, grid, mode="bilinear", align_corners=True)
    # How TensorFlow makes levels of floats in [0, 1].
    return (cropped.clamp(0, 1) * 255.5).floor()


def resize(images: Tensor, size: int) -> Tensor:
    """Bicubic resize of images (B, 3, H, W) in 0..255 to (B, 3, size, size), without regard to the aspect ratio.

    The levels are what PIL makes of them in the checkpoints' own processor: along rows first, then along columns,
    and each time rounded to whole levels. In training the published checkpoints saw images that TensorFlow's
    lanczos3 had resized.
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
        crop: keep the middle only, see `centre_crop`; otherwise see `resize`.
    """
    levels = images if images.dtype == torch.uint8 else images.float() * 255
    pixels = (centre_crop if crop else resize)(levels, architecture.image_size) / 255
    towers = []
    for mean, std in zip(architecture.image_means, architecture.image_stds, strict=True):
        shift, scale = (torch.tensor(v, device=pixels.device).view(3, 1, 1) for v in (mean, std))
        towers.append((pixels - shift) / scale)
    return torch.cat(towers, dim=1)
