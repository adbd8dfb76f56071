"""What is asked of a policy, of who acts, and of who learns. A policy plugin never imports this module."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from cronos_lerobot.agents.weights import save_policy

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from torch.optim import Optimizer

Columns = dict[str, np.ndarray]
"""Observations by LeRobot's names, as the environment made them: images uint8 (B, H, W, 3), vectors float32."""
Batch = dict[str, Any]
"""A batch by LeRobot's names, after the policy's preprocessor: `observation.*` (B, ...), `task`: B strings.
Images are (B, 3, H, W), floats in [0, 1] or, for a policy with `takes_uint8_images`, uint8 in 0..255."""

StreamSeed = Sequence[int]
"""Non-negative integers that seed the randomness of one stream."""

POLICY_METHODS = ("sample_actions", "evaluate_actions", "predict_values", "rl_parameter_groups")


@runtime_checkable
class TrainablePolicy(Protocol):
    """A LeRobot policy that PPO can train: it says how likely its own decisions were.

    A decision is what the policy answers to one observation: n actions, played one after the other without looking
    (n = 1: it looks at every control step), and a trace, which is all that `evaluate_actions` needs to know which
    decision it was: tokens, a sample before it was squashed, a denoising chain.

    A policy that decides on more than one action says on how many: its attribute `decision_steps`. One that looks
    at more than one observation says at how many: `observation_steps`. Its batches have `observation.*`
    (B, observation_steps, ...), oldest first, of what has happened since the task began.

    A policy whose first layers are frozen may also have `encode_observation(batch) -> Batch` (or None there),
    which replaces inputs by what those layers make of them. It is called once for each observation; what it
    returns is kept until the update and handed to the other methods instead of the batch.

    A policy whose attribute `takes_uint8_images` is true gets camera frames as they are, uint8 in 0..255, and
    scales them itself. Without it, or if its preprocessor normalises images, they are floats in [0, 1].

    A policy may have `value_inputs(batch) -> Batch` (or None there): all that the value depends on, up to the
    first parameter of the group `value`. It is called once for each observation in an update, after the policy's
    training; the passes that train the value alone then call `predict_values` with what it returned.

    `sample_actions` may also take `uniform`, numbers (B, A) in [0, 1) that are its randomness instead of a
    generator. An evaluation then draws them for each episode and step, and an episode's actions do not depend on
    which others share its batch.
    """

    def sample_actions(
        self, batch: Batch, *, temperature: float = 1.0, generator: torch.Generator | None = None
    ) -> dict[str, Tensor]:
        """Return `actions` (B, n, A) normalised, `trace` (B, ...), `log_prob` [nats], `value` (B,).

        The trace keeps its type and shape. `log_prob` is (B,), or (B, L) by factor: those of the L parts of the
        decision, such as the steps of a denoising chain, whose sum is the decision's.
        """
        ...

    def evaluate_actions(
        self, batch: Batch, trace: Tensor, *, temperature: float = 1.0
    ) -> dict[str, Tensor | None]:
        """Return, differentiably, `log_prob` (B,) or (B, L), `entropy` (B,), `value` (B,).

        The entropy is the mean over the dimensions [nats], or None of a policy that cannot say it.
        """
        ...

    def predict_values(self, batch: Batch) -> Tensor:
        """Return, differentiably, the values (B,) of observations."""
        ...

    def rl_parameter_groups(self) -> list[dict[str, Any]]:
        """Return two groups, {"name": "policy" or "value", "params": [...]}, without a parameter in common.

        What is in neither of them is frozen while training. A group may have a `weight_decay` and `betas` of its
        own, for AdamW.
        """
        ...


def missing_methods(policy: Any) -> list[str]:
    """What a policy lacks of TrainablePolicy. `isinstance` would not see methods of what PEFT wraps."""
    return [name for name in POLICY_METHODS if not callable(getattr(policy, name, None))]


def samples(policy: Any) -> bool:
    """Whether `policy` draws its actions at a temperature, by `sample_actions`."""
    return callable(getattr(policy, "sample_actions", None))


def decision_steps(policy: Any, task_switch_interval: int | None = None) -> int:
    """How many actions a policy decides on at once, n.

    Args:
        policy: a TrainablePolicy.
        task_switch_interval: K, if it is known: no decision may reach beyond a task switch.

    Raises:
        ValueError: n does not divide K.
    """
    n = int(getattr(policy, "decision_steps", 1))
    if task_switch_interval is not None and task_switch_interval % n:
        fitting = [m for m in range(1, n) if task_switch_interval % m == 0]
        raise ValueError(
            f"the policy plays {n} actions at once, which does not divide --protocol.task_switch_interval="
            f"{task_switch_interval}: it would act on the old task's decision after a switch. Choose --policy."
            f"n_action_steps from {fitting}, or another interval."
        )
    return n


def observation_steps(policy: Any) -> int:
    """How many observations a TrainablePolicy looks at."""
    return int(getattr(policy, "observation_steps", 1))


@dataclass(frozen=True)
class ActionSample:
    """Actions for one control step of this process's streams, and what a recording says of them."""

    action: np.ndarray
    """(N, A) float32 in physical units. `act` returns what the policy chose; `store` and recordings get what was
    executed."""
    log_prob: np.ndarray | None = None
    """(N,) float32 [nats], of the decision that the action is of; None if unknown."""
    value: np.ndarray | None = None
    """(N,) float32, that policy's value of the observation that was decided on; None if unknown."""
    intervened: np.ndarray | None = None
    """(N,) bool, of all processes' streams: a person or a script chose the action. None where nobody can."""


class Actor(Protocol):
    """Who acts in evaluations, videos and recordings, in some of the streams. The caller numbers the streams."""

    is_per_stream: bool = True
    """Whether it keeps the streams apart. If not, `act` gets all streams, and `begin` forgets all of them."""
    temperature: float | None = None
    """Sampling temperature; None if it does not sample at one."""

    def seed(self, seed: int) -> None:
        """Seed the randomness that all streams share."""
        return

    def begin(self, ids: np.ndarray, seeds: Sequence[StreamSeed] | None = None) -> None:
        """Begin a new task in streams `ids`: forget plans and past observations.

        Args:
            ids: (k,) streams.
            seeds: k seeds of their own randomness; None continues with the randomness that they have.
        """
        return

    @abstractmethod
    def act(self, observation: dict[str, Any], instructions: list[str], ids: np.ndarray) -> ActionSample:
        """Choose the next action of streams `ids` (k,).

        Args:
            observation: raw, k rows.
            instructions: k current instructions.
            ids: (k,) streams.
        """
        ...


class Agent(Protocol):
    """Lines 11, 13 and 16 to 18 of Algorithm 1."""

    @abstractmethod
    def act(self, o_t: dict[str, Any], tau: list[str]) -> ActionSample:
        """Sample actions for the raw observation `o_t` under the instructions `tau`."""
        ...

    @abstractmethod
    def store(
        self,
        o_t: dict[str, Any],
        tau: list[str],
        a_t: ActionSample,
        r_t: np.ndarray,
        o_tp1: dict[str, Any],
        cut_t: np.ndarray,
        diverged_t: np.ndarray,
    ) -> None:
        """Keep one transition of every stream.

        Args:
            o_t: the observation that was acted on.
            tau: the instructions.
            a_t: what `act` returned, with the executed action and, in `intervened`, who was helped.
            r_t: (N,), the reward.
            o_tp1: the observation after the step.
            cut_t: (N,) bool, the trace ends with this step.
            diverged_t: (N,) bool, the simulation broke down: the step has no outcome.
        """
        ...

    @abstractmethod
    def update(self) -> dict[str, float]:
        """Learn from what was stored, forget it, and return metrics."""
        ...


class LearningAgent(Agent):
    """An agent that `cronos-train` can run, save and resume; its defaults are those of one that only has a policy.

    `act` gets the observations of this process's streams and the instructions of all N; so do `store`'s arguments.
    """

    policy: Any
    """The LeRobot policy that acts: what is saved, and evaluated unless `acting` is another."""
    optimizer: Optimizer | dict[str, Optimizer] | None = None
    """Saved and loaded as LeRobot does it."""
    describes: tuple[str, ...] = ()
    """What `act` says of its actions: some of "log_prob" and "value". Recordings have a column for each."""

    @property
    def acting(self) -> Any:
        """What is evaluated: the policy, or what decides in its place by `sample_actions`.

        Another than the policy has a `push_to_hub`, as LeRobot's HubMixin, for what lies beside the policy.
        """
        return self.policy

    def save_pretrained(self, folder: Path) -> None:
        """Save the policy, and what else `acting` is made of, as LeRobot loads it from a folder."""
        save_policy(self.policy, folder)

    def end_step(self, success: np.ndarray) -> None:
        """The step last stored left the tasks complete where `success` (N,) bool says so; before any `update`."""
        return

    def end_segment(self, success: np.ndarray, found_complete: np.ndarray) -> None:
        """A segment of every stream is over and its resets are done; the next observation is of a new one.

        Args:
            success: (N,) bool, complete at any step of the segment.
            found_complete: (N,) bool, a success for which nothing had to be done.
        """
        return

    def shared_tensors(self) -> Iterable[Tensor]:
        """What all processes must have alike after an update; it is checked."""
        return (param for param in self.policy.parameters() if param.requires_grad)

    def state_dict(self) -> dict[str, Any]:
        """What the agent needs to go on bit for bit, beside policy, optimizer and the context's generators.

        All processes call it, once before the run as well, and the first one's answer, which covers all streams,
        is kept: nested dicts, lists and tuples of tensors, NumPy arrays, numbers, strings and None. They come back
        as they were, tensors on the CPU; anything else is an error.
        """
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from the first process's `state_dict`, in every process, perhaps with another config.

        The policy, the optimizer and the generators are loaded already.
        """
        return
