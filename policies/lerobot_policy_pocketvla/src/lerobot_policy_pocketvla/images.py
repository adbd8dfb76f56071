"""Camera frames: what is checked of them."""

from torch import Tensor


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
