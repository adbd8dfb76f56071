"""Generalised advantage estimation (Schulman et al., 2016) on streams that are never done.

A stream has no terminal states while training, but its trace is cut wherever the next frame is not the outcome
of the action under the same instruction. What the trace is bootstrapped from there:

| boundary                       | trace | bootstrapped from                                             |
|--------------------------------|-------|---------------------------------------------------------------|
| none (also a success)          | whole | V(o_{t+1}, tau), the next row                                 |
| policy update (every U)        | cut   | V(o_{t+1}, tau)                                               |
| task switch (every K)          | cut   | V(o_{t+1}, tau) under the OLD instruction                     |
| end-effector reset             | cut   | V(o_{t+1}, tau) BEFORE the arm goes home, OLD instruction     |
| heuristic or scene reset       | cut   | V(o_{t+1}, tau) BEFORE the reset, OLD instruction             |
| diverged simulation            | cut   | V(o_t, tau): there is no o_{t+1}                              |

Nothing is ever multiplied by zero: none of these ends is one that the policy brought about.
"""

from __future__ import annotations

import numpy as np


def compute_gae(
    rewards: np.ndarray,
    values: np.ndarray,
    boundaries: np.ndarray,
    bootstrap_values: np.ndarray,
    gamma: float,
    gae_lambda: float,
    durations: np.ndarray | int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (advantages, returns), each (T, N) float32.

    Args:
        rewards: (T, N) r_t.
        values: (T, N) V(o_t, tau_t).
        boundaries: (T, N) bool, the trace is cut after row t.
        bootstrap_values: (T, N), read where `boundaries` is set: see the table above.
        gamma: discount factor, per control step.
        gae_lambda: weight of the longer returns, per row.
        durations: (T, N) or a number, control steps that a row took. A row of several is a decision that was
            played open loop, its reward the sum of gamma^i r_{t+i}: a semi-Markov problem (Sutton et al., 1999).

    Raises:
        ValueError: the last row is not a boundary: there is nothing to bootstrap it from.
    """
    if not boundaries[-1].all():
        streams = np.flatnonzero(~boundaries[-1]).tolist()
        raise ValueError(f"The last row must be a boundary of every stream; it is not of streams {streams}.")
    advantages = np.zeros(rewards.shape, np.float64)
    discounts = np.broadcast_to(gamma ** np.asarray(durations, np.float64), rewards.shape)
    next_advantage = np.zeros(rewards.shape[1], np.float64)
    next_value = np.zeros(rewards.shape[1], np.float64)
    for t in reversed(range(len(rewards))):
        # V_{t+1} = bootstrap where the trace is cut, else V(o_{t+1}, tau_{t+1})
        next_value = np.where(boundaries[t], bootstrap_values[t], next_value)
        # delta_t = r_t + gamma^d V_{t+1} - V_t, d the row's duration
        delta = rewards[t] + discounts[t] * next_value - values[t]
        # A_t = delta_t + gamma^d lambda A_{t+1}, without the last term where the trace is cut
        next_advantage = delta + discounts[t] * gae_lambda * np.where(boundaries[t], 0.0, next_advantage)
        advantages[t] = next_advantage
        next_value = values[t]
    # R_t = A_t + V_t
    return advantages.astype(np.float32), (advantages + values).astype(np.float32)
