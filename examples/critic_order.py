"""A task order that goes by the agent's values: tasks that are neither hopeless nor certain come first.

    PYTHONPATH=examples cronos-train --protocol.discover_packages_path=critic_order --protocol.task_order=critic \
        --algorithm.type=ppo --policy.path=<checkpoint> --env.type=cronos --output_dir=outputs/critic_order

V / CERTAIN_VALUE stands for p, the chance of a success. A task is drawn in proportion to
(p (1 - p) + FLOOR) ** SHARPNESS. Tasks that are complete already are left out, unless all are.
"""

import numpy as np

from cronos_lerobot.protocol import LoopState, RunContext, register_task_order

CERTAIN_VALUE = 0.8
"""The value of a success some twenty steps away at gamma = 0.99, for --protocol.reward=difference."""
FLOOR, SHARPNESS = 0.02, 2.0


@register_task_order("critic")
class CriticOrder:
    """Draws tasks by the values of PPO's agent, or of your own with a method `predict_values`."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng

    def bind(self, run: RunContext) -> None:
        """Take the agent and the environment of the run."""
        if not hasattr(run.agent, "predict_values"):
            raise ValueError("--protocol.task_order=critic needs an agent with values: --algorithm.type=ppo.")
        self.run = run

    def draw(self, loop: LoopState) -> np.ndarray:
        """The next task of every stream, (N,)."""
        odds = weigh(task_values(self.run), self.run.env.find_complete(self.run.tasks)).cumsum(axis=1)
        drawn = self.rng.random(loop.num_streams)[:, None] * odds[:, -1:]
        return (odds > drawn).argmax(axis=1)


def task_values(run: RunContext) -> np.ndarray:
    """The agent's values (N, tasks) of every task, from where each stream stands."""
    seen = run.env.observe_under(run.tasks)
    columns = [
        run.agent.predict_values(observation, [task.instruction] * run.env.num_envs)
        for task, observation in zip(run.tasks, seen, strict=True)
    ]
    return np.stack(columns, axis=1).astype(np.float64)


def weigh(values: np.ndarray, complete: np.ndarray) -> np.ndarray:
    """What the probabilities (N, tasks) are proportional to; `complete` (N, tasks) bool is left out."""
    p = (values / CERTAIN_VALUE).clip(0, 1)
    weights = (p * (1 - p) + FLOOR) ** SHARPNESS
    return np.where(complete & ~complete.all(axis=1, keepdims=True), 0.0, weights)
