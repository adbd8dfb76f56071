"""Processes that train together without importing LeRobot again, and streams that are the same in any process."""

import faulthandler
import multiprocessing
import os
import queue
import socket
import tempfile
import traceback
from pathlib import Path

import cloudpickle
import faster  # noqa: F401
import lerobot_policy_pocketvla  # noqa: F401  (a server that another test has started may not have it)
import numpy as np
import pytest
import torch
from dummies import DummyEnv, DummyPolicy
from runs import DIVERGES, KilledError

from cronos_lerobot.ranks import join_ranks

SERVER = multiprocessing.get_context("forkserver")
"""Forks a process that has imported LeRobot and done nothing else: no child inherits the threads and locks of the
tests before, with which it may wait for ever, nor does any import LeRobot anew."""
SERVER.set_forkserver_preload(
    ["lerobot.datasets", "lerobot_policy_pocketvla", "cronos_lerobot.training.factory", "pytest"]
)

PATIENCE_S = 120


def together(function, *args, count=2):
    """Run `function(processes, *args)` in `count` processes as `accelerate launch` starts them; their results."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    results = SERVER.Queue()
    work = cloudpickle.dumps((function, args))
    with tempfile.TemporaryDirectory() as stacks:
        children = [
            SERVER.Process(target=_child, args=(rank, count, port, results, work, f"{stacks}/{rank}"))
            for rank in range(count)
        ]
        for child in children:
            child.start()
        try:
            answers = dict(results.get(timeout=PATIENCE_S) for _ in children)
            for child in children:
                child.join(timeout=60)
        except queue.Empty:
            pytest.fail(
                "\n".join([f"no answer in {PATIENCE_S} s", *[p.read_text() for p in Path(stacks).iterdir()]])
            )
        finally:
            for child in children:
                child.kill()
    for rank, (_, error) in sorted(answers.items()):
        assert error is None, f"process {rank}:\n{error}"
    return [answers[rank][0] for rank in range(count)]


def _child(rank, count, port, results, work, stacks):
    torch.set_num_threads(1)
    os.environ |= {
        "RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count),
        "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    with open(stacks, "w") as file:
        faulthandler.dump_traceback_later(PATIENCE_S - 10, file=file)
        try:
            function, args = cloudpickle.loads(work)
            joined = join_ranks("cpu")
            answer = function(joined, *args), None
            joined.leave()
        except BaseException:
            answer = None, traceback.format_exc()
        faulthandler.cancel_dump_traceback_later()
    results.put((rank, answer))


class WanderingEnv(DummyEnv):
    """Part of a world of streams, in which body "a" is lost beyond 1.4 and put back at a random place."""

    def __init__(self, num_envs, first=0, dies_at=None):
        diverge_at = {(t, i - first) for t, i in DIVERGES if first <= i < first + num_envs}
        super().__init__(num_envs, diverge_at=diverge_at)
        self.dies_at = dies_at

    def step(self, actions):
        if self.t == self.dies_at:
            raise KilledError
        return super().step(3 * actions)

    def _observation(self):
        observation = super()._observation()
        observation["agent_pos"][:, 1] = self.t / 32
        return observation

    def unsuitable_bodies(self):
        return np.stack([np.abs(self.x) > 1.4, *[np.zeros(self.num_envs, bool)] * 2], axis=1)

    def put_back(self, stream, body, rng):
        # Rejection sampling: how many numbers it takes depends on what is drawn.
        while (place := rng.uniform(-3, 3)) > 0.7:
            pass
        self.x[stream] = max(place, -1.0)


class ScriptedPolicy(DummyPolicy):
    """Acts by what it sees, not by chance or by its weights, so that its streams are the same in any process."""

    def sample_actions(self, batch, *, temperature=1.0, generator=None):
        noise = torch.sin(777 * batch["observation.state"][:, :2].sum(dim=1, keepdim=True) + torch.arange(7.0))
        tokens = ((noise + 1) / 2 * 3).long().clamp(0, 2)
        log_prob = self._distribution(batch, temperature or 1.0).log_prob(tokens).sum(dim=1)
        value = self.predict_values(batch)
        return {"actions": tokens.float()[:, None] - 1, "trace": tokens, "log_prob": log_prob, "value": value}
