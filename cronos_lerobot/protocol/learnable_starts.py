"""Scene resets to where something is left to learn: a configuration and the task that comes first there."""

from __future__ import annotations

from typing import Any

import numpy as np

from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.loop_state import LoopState
from cronos_lerobot.protocol.reset_strategy import ResetStrategy
from cronos_lerobot.protocol.task_values import RunContext


class LearnableStarts(ResetStrategy):
    """Scene resets go where the policy neither always succeeds nor always fails (not in the paper).

    A start is a training configuration and the task that is given first there. Of each it is kept how many of
    the segments that began so were successes. With the prior Beta(2 r, 2 (1 - r)), where r is their rate over
    all starts, a start is drawn with a probability proportional to the square of the expected p (1 - p), its
    learnability (Tzannetos et al., 2023; Rutherford et al., 2024, who take the highest), where one that was never
    tried counts for what the others are on average. Each new outcome takes a fifth of what earlier ones of its
    start count for, since the policy has changed since then.

    It goes by outcomes alone, so that it serves every agent and policy, and changes neither how many scene
    resets there are nor when or for which stream: that is decided by the strategy that it is put around. What an
    expert has done, and a segment in which the simulation broke down, say nothing of the policy at that start.

    Args:
        inner: decides when scene resets are due, and counts them.
        rng: draws the starts.
        num_configurations: draws only from the first so many of the training split's 64.
    """

    kind = Intervention.SCENE_RESET
    PRIOR_STRENGTH = 2.0
    """Outcomes that the prior counts for. Policies that were trained with few resets fail in .09 of all starts and
    in .31 of those where they have failed once, for which it is 3.3; before training they fail more often."""
    MEMORY = 0.8
    """What an outcome counts for when the next one of the same start is known."""
    SHARPNESS = 2.0
    """The power of the learnability that a start is drawn by; 0 would be uniform."""

    def __init__(self, inner: ResetStrategy, rng: np.random.Generator, num_configurations: int) -> None:
        self.inner, self.rng, self.num_configurations = inner, rng, num_configurations
        self._outcomes = np.empty((num_configurations, 0, 2))  # (configurations, tasks, 2): failures, successes
        self._awaited = np.empty(0, np.int64)  # (N,): the configuration that the segment began in; -1 is no start
        self._divergences = np.empty(0, np.int64)  # (N,): those that each stream had had then

    def bind(self, run: RunContext) -> None:
        """Tell the strategy that decides when."""
        self.inner.bind(run)

    def state_dict(self) -> dict[str, Any]:
        """The outcomes by start, and where the streams are of which no outcome is known yet."""
        if not self._outcomes.size:
            return {}
        own = {"outcomes": self._outcomes, "awaited": self._awaited, "divergences": self._divergences}
        return own | {"inner": self.inner.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from `state_dict`; of configurations that a resumed run no longer draws from nothing is kept."""
        kept = state["outcomes"][: self.num_configurations]
        self._outcomes = np.zeros((self.num_configurations, *kept.shape[1:]))
        self._outcomes[: len(kept)] = kept
        self._awaited = np.where(state["awaited"] < self.num_configurations, state["awaited"], -1)
        self._divergences = state["divergences"].copy()
        if state["inner"]:
            self.inner.load_state_dict(state["inner"])

    def due(self, env: Any, loop: LoopState) -> np.ndarray:
        """Note what has come of the last starts, ask the strategy that decides when, and draw starts for those."""
        if not self._outcomes.size:
            self._outcomes = np.zeros((self.num_configurations, loop.num_tasks, 2))
            self._awaited = np.full(loop.num_streams, -1, np.int64)
        else:
            self._note(loop)
        ids = self.inner.due(env, loop)
        weights = self.weigh().ravel()
        drawn = self.rng.choice(weights.size, size=len(ids), p=weights / weights.sum())
        self._awaited[ids], loop.first_task[ids] = np.divmod(drawn, loop.num_tasks)
        self._divergences = loop.interventions[:, Intervention.DIVERGENCE].copy()
        return ids

    def apply(self, env: Any, ids: np.ndarray) -> None:
        """Place the streams `ids` at their starts."""
        env.scene_reset(ids, self._awaited[ids])

    def count(self, loop: LoopState, ids: np.ndarray) -> None:
        """Count them as the strategy that decides when does."""
        self.inner.count(loop, ids)

    def weigh(self) -> np.ndarray:
        """Weights (configurations, tasks) that the probabilities of the starts are proportional to."""
        failures, successes = np.moveaxis(self._outcomes, -1, 0)
        rate = (successes.sum() + 1) / (self._outcomes.sum() + 2)
        a = self.PRIOR_STRENGTH * rate + successes
        b = self.PRIOR_STRENGTH * (1 - rate) + failures
        return (a * b / ((a + b) * (a + b + 1))) ** self.SHARPNESS

    def _note(self, loop: LoopState) -> None:
        same_scene = self._divergences == loop.interventions[:, Intervention.DIVERGENCE]
        for stream in np.flatnonzero((self._awaited >= 0) & same_scene & ~loop.taken_over):
            start = self._outcomes[self._awaited[stream], loop.task[stream]]
            start *= self.MEMORY
            start[loop.recent_success[stream, -1]] += 1
        self._awaited[:] = -1
