"""The critic: a value read off the language model's hidden state."""

from torch import Tensor, nn

WIDTHS = (512, 128)


class ValueHead(nn.Module):
    """Three layers with GELU between, float32, zero at the start.

    Args:
        width: of the hidden state where the first action token is predicted.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        first, second = WIDTHS
        out = nn.Linear(second, 1)
        nn.init.zeros_(out.weight)
        nn.init.zeros_(out.bias)
        self.layers = nn.Sequential(nn.Linear(width, first), nn.GELU(), nn.Linear(first, second), nn.GELU(), out)

    def forward(self, hidden: Tensor) -> Tensor:
        """Hidden states (B, width) to values (B,)."""
        return self.layers(hidden.float()).squeeze(-1)
