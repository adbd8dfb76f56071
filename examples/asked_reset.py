"""Scene resets for streams that are stuck, as many as a budget has by then, instead of periodic ones.

    PYTHONPATH=examples cronos-train --protocol.discover_packages_path=asked_reset \
        --protocol.extra_resets='[asked]' --protocol.scene_reset_interval=null --protocol.reset_budget=1000 \
        --policy.path=<checkpoint> --env.type=cronos --output_dir=outputs/asked_reset

A stream is stuck if it has failed its last FAILURES tasks, all since its last scene reset. Those come first in
which the agent's best value over the tasks is lowest; without values those whose last reset is the longest ago.
After a share of the run's steps no more than that share of the budget is spent.
"""

import numpy as np

from cronos_lerobot.protocol import LoopState, ProtocolConfig, RunContext, SceneReset, register_reset

FAILURES = 2


@register_reset("asked")
class AskedReset(SceneReset):
    """A strategy of its own kind: it counts as a scene reset and spends --protocol.reset_budget."""

    def __init__(self, rng: np.random.Generator, protocol: ProtocolConfig) -> None:
        super().__init__(rng, protocol.num_configurations)
        if protocol.reset_budget is None or protocol.learned_reset:
            raise ValueError(
                "--protocol.extra_resets=[asked] needs --protocol.reset_budget, and no learned reset."
            )
        self.budget = protocol.reset_budget

    def bind(self, run: RunContext) -> None:
        """Take the length of the run, and its agent's values if it has some."""
        self.run = run

    def due(self, env, loop: LoopState) -> np.ndarray:
        """Of the streams that are stuck the worst ones, as many as may be reset by now."""
        affordable = int(self.budget * loop.n / self.run.total_steps) - loop.b
        stuck = find_stuck(loop)
        if affordable < 1 or not len(stuck) or loop.n >= self.run.total_steps:
            return np.empty(0, np.int64)
        order = np.lexsort((-loop.segments_since_reset[stuck], self._best_values(loop)[stuck]))
        return np.sort(stuck[order[:affordable]])

    def _best_values(self, loop: LoopState) -> np.ndarray:
        run = self.run
        if not hasattr(run.agent, "predict_values"):
            return np.zeros(loop.num_streams)
        seen = run.env.observe_under(run.tasks)
        values = [
            run.agent.predict_values(observation, [task.instruction] * loop.num_streams)
            for task, observation in zip(run.tasks, seen, strict=True)
        ]
        # A task that is complete has nothing left to give.
        return np.where(run.env.find_complete(run.tasks), 0, np.stack(values, axis=1)).max(axis=1)


def find_stuck(loop: LoopState) -> np.ndarray:
    """Ids (k,) of the streams that have failed their last tasks, all of them since their scene reset."""
    failed = (loop.recent_success[:, -FAILURES:] == 0).all(axis=1)
    return np.flatnonzero(failed & (loop.segments_since_reset >= FAILURES))
