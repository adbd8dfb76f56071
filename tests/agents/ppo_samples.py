"""A PPO on the linear dummy policy, and rollouts for it."""

import numpy as np
import torch
from dummies import TASKS, DummyPolicy, identity_processors

from cronos_lerobot.agents.decisions import Decision
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.ppo.ppo import PPO
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer
from cronos_lerobot.agents.processing import PolicyProcessors


def make_ppo(seed=0, policy=None, **options):
    options = {"minibatch_size": 64, "value_warmup_updates": 0, "policy_lr_max": 1e3} | options
    policy = policy or DummyPolicy(seed=seed)
    return PPO(policy, PolicyProcessors(*identity_processors()), PPOConfig(**options), np.random.default_rng(seed))


def rollout(ppo, reward, rows=16, streams=8):
    """Rows that each end their own trace, so that the return is the reward plus nothing."""
    rng = np.random.default_rng(3)
    buffer = RolloutBuffer(rows, streams)
    for _ in range(rows):
        columns = {"observation.state": rng.normal(size=(streams, 2)).astype(np.float32)}
        instructions = [TASKS[i].instruction for i in rng.integers(4, size=streams)]
        with torch.no_grad():
            sample = ppo.policy.sample_actions(
                ppo.processors.batch(columns, instructions), generator=torch.Generator().manual_seed(7)
            )
        sample = Decision(*(sample[k].numpy() for k in ("actions", "trace", "log_prob", "value")), columns)
        buffer.add(sample, instructions, reward(sample), np.full(streams, True), np.zeros(streams))
    return buffer


def reward_for_up(sample):
    return (sample.trace[:, 0] == 2).astype(np.float32)


def flat(params):
    return torch.cat([p.detach().flatten() for p in params])
