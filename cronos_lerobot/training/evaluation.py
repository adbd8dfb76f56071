"""Independent evaluation while training: scene reset, one task, 80 steps, success if complete at any step.

`cronos-eval` (`cronos_lerobot.evaluation`) runs the same episodes with other random numbers.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot_env_cronos import STEPS_PER_TASK

from cronos_lerobot.agents.processing import PolicyProcessors, observation_columns
from cronos_lerobot.evaluation.rates import SuccessRate
from cronos_lerobot.processes import Processes


@dataclass(frozen=True)
class EvaluationResult:
    """What an independent evaluation came to."""

    split: str
    temperature: float
    configurations: list[int]
    successes: dict[str, list[bool]] = field(default_factory=dict)
    """By instruction: one flag for each configuration."""

    @property
    def overall(self) -> SuccessRate:
        """All tasks together."""
        flags = [flag for task in self.successes.values() for flag in task]
        return SuccessRate(sum(flags), len(flags))

    def to_dict(self) -> dict[str, Any]:
        """Return rates with their intervals, overall and by task."""
        return {
            "split": self.split,
            "temperature": self.temperature,
            **self.overall.to_dict(),
            "per_task": {task: SuccessRate(sum(f), len(f)).to_dict() for task, f in self.successes.items()},
        }


@torch.inference_mode()
def evaluate_independent(
    env: Any,
    tasks: Sequence[Any],
    policy: Any,
    processors: PolicyProcessors,
    *,
    configurations: Sequence[int] = tuple(range(64)),
    split: str = "train",
    temperature: float = 0.6,
    seed: int = 1000,
    num_steps: int = STEPS_PER_TASK,
    processes: Processes | None = None,
) -> EvaluationResult:
    """Evaluate a policy on every task from every configuration.

    The sampling is seeded, so the same policy gets the same result whenever it is asked, as long as
    `env.num_envs`, the order of tasks and configurations and the number of processes stay the same.

    Args:
        env: environments of the evaluation's own, never those of a training stream.
        tasks: the tasks to evaluate.
        policy: a TrainablePolicy.
        processors: between `env` and `policy`.
        configurations: indices into the split.
        split: `train` or `held_out`.
        temperature: of the sampling, 0 for the likeliest action.
        seed: of the sampling.
        num_steps: control steps of an episode.
        processes: that share out the episodes; all call this and get the whole result.
    """
    processes = processes or Processes()
    was_training = policy.training
    policy.eval()
    generator = torch.Generator(device=processors.device)
    generator.manual_seed(seed + processes.rank)
    result = EvaluationResult(split, temperature, list(configurations), {task.instruction: [] for task in tasks})
    jobs = [(task, configuration) for task in tasks for configuration in configurations]
    flags: list[bool] = []
    for batch in _batches(_share_of(jobs, processes), env.num_envs):
        _place(env, batch, split)
        succeeded = _rollout(env, policy, processors, temperature, generator, num_steps, len(batch))
        flags += succeeded[: len(batch)].tolist()
    policy.train(was_training)
    for (task, _), success in zip(jobs, itertools.chain(*processes.gather(flags)), strict=True):
        result.successes[task.instruction].append(success)
    return result


def _share_of(jobs: list[tuple[Any, int]], processes: Processes) -> list[tuple[Any, int]]:
    """The episodes of this process: neighbours, about as many as the others'."""
    first, last = (len(jobs) * rank // processes.count for rank in (processes.rank, processes.rank + 1))
    return jobs[first:last]


def _batches(jobs: list[tuple[Any, int]], size: int) -> Iterator[list[tuple[Any, int]]]:
    for start in range(0, len(jobs), size):
        yield jobs[start : start + size]


def _place(env: Any, batch: list[tuple[Any, int]], split: str) -> None:
    """Put one episode on each environment; those left over repeat the last one and are not counted."""
    padded = batch + [batch[-1]] * (env.num_envs - len(batch))
    ids = np.arange(env.num_envs)
    env.scene_reset(ids, np.array([configuration for _, configuration in padded]), split=split)
    env.set_task(ids, [task for task, _ in padded])


def _rollout(
    env: Any,
    policy: Any,
    processors: PolicyProcessors,
    temperature: float,
    generator: torch.Generator,
    num_steps: int,
    num_episodes: int,
) -> np.ndarray:
    """Return (num_envs,) bool, whether the task was complete at any step.

    An episode ends with its success: only the others are simulated and observed any further. The policy sees the
    whole batch, the last observation of those that ended, so that every episode keeps its random numbers.
    """
    instructions = [task.instruction for task in env.tasks]
    succeeded = np.zeros(env.num_envs, np.bool_)
    columns = {key: rows.copy() for key, rows in observation_columns(env.observe()).items()}
    running = np.arange(num_episodes)
    for _ in range(num_steps):
        sample = policy.sample_actions(
            processors.batch(columns, instructions), temperature=temperature, generator=generator
        )
        _, diverged = env.step_streams(processors.physical_actions(sample["action"]), running)
        # A simulation that broke down ends its episode, and proves nothing, whatever it shows.
        succeeded[running] = (env.is_success & ~diverged)[running]
        running = running[~(succeeded | diverged)[running]]
        if not len(running):
            break
        for key, rows in observation_columns(env.observe(running)).items():
            columns[key][running] = rows
    return succeeded
