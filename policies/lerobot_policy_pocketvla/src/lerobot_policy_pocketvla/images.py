"""Camera frames: scaling, checks and augmentation."""

import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812


def to_signed_unit_range(images: Tensor, dtype: torch.dtype) -> Tensor:
    """Map images to [-1, 1]: uint8 from 0..255, floats from [0, 1].

    Args:
        images: (B, 3, H, W).
        dtype: of the result.
    """
    if images.dtype == torch.uint8:
        # 0..255 and its half steps are exact in bfloat16, so this equals the float path up to one rounding.
        return images.to(dtype).sub_(127.5).mul_(1.0 / 127.5)
    return (images.float() * 2.0).sub_(1.0).to(dtype)


def check_image_size(images: Tensor, expected: tuple[int, int, int], key: str) -> None:
    """Refuse images of another size than the policy was trained at.

    Raises:
        ValueError: naming both sizes.
    """
    if images.ndim != 4 or tuple(images.shape[1:]) != expected:
        raise ValueError(
            f"{key} has shape {tuple(images.shape)}, but this policy was trained at "
            f"(batch, {expected[0]}, {expected[1]}, {expected[2]}), height and width last. "
            f"Render or resize to {expected[1]} x {expected[2]}, or train a policy at the other size."
        )


def random_shift(images: Tensor, pixels: int, generator: torch.Generator | None = None) -> Tensor:
    """Shift each image by its own whole number of pixels in [-pixels, pixels] a side, edges repeated.

    The augmentation of DrQ (Kostrikov et al. 2020, section 3.1).

    Args:
        images: (B, C, H, W), any dtype.
        pixels: largest shift; 0 returns the images as they are.
    """
    if pixels == 0:
        return images
    batch, _, height, width = images.shape
    device = images.device
    shift = torch.randint(-pixels, pixels + 1, (2, batch, 1), generator=generator, device=device)
    rows = (torch.arange(height, device=device) + shift[0]).clamp_(0, height - 1)
    columns = (torch.arange(width, device=device) + shift[1]).clamp_(0, width - 1)
    samples = torch.arange(batch, device=device)[:, None, None]
    shifted = images.permute(0, 2, 3, 1)[samples, rows[:, :, None], columns[:, None, :]]
    return shifted.permute(0, 3, 1, 2)


def spatial_softmax(maps: Tensor) -> Tensor:
    """Expected image position of each map, (B, K, H, W) to (B, 2K): first all x, then all y, in [-1, 1].

    Levine et al. 2016, "End-to-End Training of Deep Visuomotor Policies", section 5.2.
    """
    height, width = maps.shape[-2:]
    weights = F.softmax(maps.flatten(2).float(), dim=-1).unflatten(-1, (height, width))
    x = torch.linspace(-1.0, 1.0, width, device=maps.device)
    y = torch.linspace(-1.0, 1.0, height, device=maps.device)
    return torch.cat((weights.sum(-2) @ x, weights.sum(-1) @ y), dim=-1)
