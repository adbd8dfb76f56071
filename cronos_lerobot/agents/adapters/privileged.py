"""A critic on the privileged state: where everything is, how the robot stands, and what it is told to do."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from cronos_lerobot.agents.adapters.registry import Adapter, CriticAdapter
from cronos_lerobot.agents.base import Batch

TEXT_WIDTH = 32


class PrivilegedCritic(CriticAdapter):
    """An adapter whose values are those of a critic on the privileged state (asymmetric; Pinto et al., 2018).

    The critic reads `observation.environment_state`, `observation.state` and the instruction: a vector for each of
    its words and their pairs, the same in every run. A value costs no look at the pictures.

    Args:
        adapter: decides, and has the parameters of the group `policy`.
        shapes: of the observations that the environment shows, by LeRobot's names.

    Raises:
        ValueError: the environment does not show the state; the message has the flag that would.
    """

    def __init__(self, adapter: Adapter, shapes: Mapping[str, tuple[int, ...]]) -> None:
        if missing := {OBS_ENV_STATE, OBS_STATE} - shapes.keys():
            raise ValueError(
                f"--algorithm.critic_observation=environment_state reads {', '.join(sorted(missing))}, which the "
                f"environment does not show: --env.privileged_state=true does beside pixels."
            )
        super().__init__(adapter.policy, shapes[OBS_ENV_STATE][0] + shapes[OBS_STATE][0] + TEXT_WIDTH)
        self.adapter: Any = adapter
        self.decision_steps, self.observation_steps = adapter.decision_steps, adapter.observation_steps

    def sample_actions(self, batch: Batch, **options: Any) -> dict[str, Tensor]:
        """See `TrainablePolicy`; options are the adapter's own."""
        return self.adapter.sample_actions(batch, **options) | {"value": self.predict_values(batch)}

    def evaluate_actions(
        self, batch: Batch, trace: Tensor, *, temperature: float = 1.0
    ) -> dict[str, Tensor | None]:
        """See `TrainablePolicy`."""
        evaluated = self.adapter.evaluate_actions(batch, trace, temperature=temperature)
        return evaluated | {"value": self.predict_values(batch)}

    def features(self, batch: Batch) -> Tensor:
        """See `CriticAdapter`."""
        texts = np.stack([text_vector(self.adapter.instruction(text)) for text in batch["task"]])
        # Of a history the latest.
        vectors = [x[:, -1] if x.ndim > 2 else x for x in (batch[OBS_ENV_STATE], batch[OBS_STATE])]
        return torch.cat([*vectors, torch.from_numpy(texts).to(vectors[0])], dim=1)

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """See `TrainablePolicy`."""
        groups = [group for group in self.adapter.rl_parameter_groups() if group["name"] == "policy"]
        return [*groups, {"name": "value", "params": [*self.critic.parameters()]}]


@lru_cache(maxsize=4096)
def text_vector(text: str) -> np.ndarray:
    """Return the sum of vectors (TEXT_WIDTH,) of its words and of pairs of neighbours, drawn by hashes of them.

    Its numbers have unit variance, as those of a normalised state.
    """
    words = text.lower().split()
    parts = words + [" ".join(pair) for pair in pairwise(words)]
    vectors = [np.random.default_rng(zlib.crc32(part.encode())).normal(size=TEXT_WIDTH) for part in parts]
    return (np.sum(vectors, axis=0) / len(parts) ** 0.5).astype(np.float32)
