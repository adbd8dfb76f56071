"""The networks behind the picture encoder: text encoder, the trunk that the task modulates, value head."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

from lerobot_policy_pocketvla.tokenizer import token_ids

STATE_LIMIT = 10.0
"""Normalised states are clipped to this many standard deviations: a dimension that hardly moved in the
demonstrations must not drown all others when it does move."""


@dataclass(frozen=True)
class TaskEmbedding:
    """The embeddings of B instructions, few of them different: what depends on them alone is computed once."""

    unique: Tensor
    """(U, width), one for each different instruction."""
    rows: Tensor
    """(B,) int64, which of them is whose."""

    def spread(self, of_unique: Tensor) -> Tensor:
        """What was computed for the different instructions, (U, features), for each of the B, (B, features)."""
        # Not of_unique[rows], whose gradient is several times slower.
        return F.embedding(self.rows, of_unique)


class TextEncoder(nn.Module):
    """Mean of hashed word and word-pair embeddings, then a small MLP.

    Args:
        vocabulary_size: number of hash buckets.
        width: width of the result.
    """

    def __init__(self, vocabulary_size: int, width: int) -> None:
        """Build the layers."""
        super().__init__()
        self.vocabulary_size = vocabulary_size
        self.embedding = nn.EmbeddingBag(vocabulary_size, width, mode="mean", padding_idx=0)
        # Normalised at the end: instructions must weigh as much as the standardised observations beside them.
        self.mlp = nn.Sequential(
            nn.LayerNorm(width),
            nn.Linear(width, width),
            nn.SiLU(),
            nn.Linear(width, width),
            nn.LayerNorm(width),
        )

    def forward(self, texts: list[str]) -> TaskEmbedding:
        """Encode B instructions; each different one is encoded once."""
        index: dict[str, int] = {}
        rows = [index.setdefault(text, len(index)) for text in texts]
        tokens = [token_ids(text, self.vocabulary_size) for text in index]
        longest = max(len(ids) for ids in tokens)
        padded = [ids + (0,) * (longest - len(ids)) for ids in tokens]
        device = self.embedding.weight.device
        unique = self.mlp(self.embedding(torch.tensor(padded, device=device)))
        return TaskEmbedding(unique, torch.tensor(rows, device=device))


class FilmMLP(nn.Module):
    """Hidden layers of one width, each normalised and modulated by the task; residual from the second on.

    The task scales and shifts features (FiLM, Perez et al. 2018), at the start by 1 and 0.

    Args:
        inputs: width of the input.
        width: width of the hidden layers and of the result.
        depth: number of hidden layers, at least 1.
        task_width: width of the task embedding, which is also appended to the input.
    """

    def __init__(self, inputs: int, width: int, depth: int, task_width: int) -> None:
        """Build the layers."""
        super().__init__()
        sizes = [inputs + task_width] + [width] * (depth - 1)
        self.linears = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in sizes)
        self.films = nn.Linear(task_width, depth * 2 * width)
        nn.init.zeros_(self.films.weight)
        with torch.no_grad():
            self.films.bias.view(depth, 2, width)[:] = torch.tensor([[1.0], [0.0]])

    def forward(self, x: Tensor, task: TaskEmbedding) -> Tensor:
        """Map x (B, inputs) under the task to (B, width)."""
        x = torch.cat((x, task.spread(task.unique)), dim=-1)
        # What depends on the task alone is done once for each task, not for each of B rows.
        films = task.spread(self.films(task.unique)).unflatten(-1, (len(self.linears), 2, -1)).unbind(1)
        for layer, (linear, norm, film) in enumerate(zip(self.linears, self.norms, films, strict=True)):
            scale, shift = film.unbind(1)
            hidden = F.silu(torch.addcmul(shift, norm(linear(x)), scale))
            x = hidden if layer == 0 else x + hidden
        return x


class StateNetwork(nn.Module):
    """Text encoder and trunk on vector observations: an actor's body, or a critic's."""

    def __init__(self, inputs: int, width: int, depth: int, task_width: int, vocabulary_size: int) -> None:
        """Build the layers."""
        super().__init__()
        self.text = TextEncoder(vocabulary_size, task_width)
        self.trunk = FilmMLP(inputs, width, depth, task_width)

    def forward(self, state: Tensor, texts: list[str]) -> Tensor:
        """Normalised states (B, inputs) and B instructions to features (B, width)."""
        return self.trunk(state.float().clamp(-STATE_LIMIT, STATE_LIMIT), self.text(texts))


class ValueHead(nn.Module):
    """Two-layer readout of a scalar value, zero at the start."""

    def __init__(self, features: int, width: int) -> None:
        """Build the layers."""
        super().__init__()
        self.hidden = nn.Linear(features, width)
        self.out = nn.Linear(width, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor) -> Tensor:
        """Features (B, F) to values (B,)."""
        return self.out(F.silu(self.hidden(features))).squeeze(-1)
