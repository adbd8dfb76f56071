"""Processes that train together without importing LeRobot again, and streams that are the same in any process."""

import faulthandler
import os
import socket
import sys
import tempfile
import traceback
from multiprocessing.connection import Connection
from pathlib import Path

import cloudpickle
import numpy as np
import pytest
import torch
from dummies import DummyEnv, DummyPolicy
from forked_commands import ForkedPopen
from lerobot.utils.import_utils import register_third_party_plugins
from runs import DIVERGES, KilledError

from cronos_lerobot.ranks import join_ranks

PATIENCE_S = 120
SERVE = "import sys, forked_processes; forked_processes.serve(sys.argv[1])"


class Together:
    """Processes as `accelerate launch` starts them, which stay for more work until one of them fails."""

    def __init__(self, count):
        self.folder = tempfile.TemporaryDirectory()
        self.log = Path(self.folder.name) / "log"
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        env = os.environ | {
            "WORLD_SIZE": str(count), "LOCAL_WORLD_SIZE": str(count), "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(port), "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
        }  # fmt: skip
        address = f"{self.folder.name}/socket"
        command = [sys.executable, "-c", SERVE, address]
        with socket.socket(socket.AF_UNIX) as server, self.log.open("wb") as log:
            server.bind(address)
            server.listen()
            server.settimeout(PATIENCE_S)
            for rank in range(count):
                ForkedPopen(command, stdout=log, env=env | {"RANK": str(rank), "LOCAL_RANK": str(rank)})
            ends = [Connection(self._accept(server)) for _ in range(count)]
        self.ends = [end for _, end in sorted((end.recv(), end) for end in ends)]

    def _accept(self, server):
        try:
            return server.accept()[0].detach()
        except TimeoutError:
            pytest.fail(self.log.read_text())

    def ask(self, work):
        """Their answers: a result and the traceback of an error, of which one is None."""
        try:
            for end in self.ends:
                end.send_bytes(work)
            return [end.recv() for end in self.ends]
        except (EOFError, ConnectionError):
            pytest.fail(f"no answer:\n{self.log.read_text()}")

    def leave(self):
        """They end once they look for more work, or wait for each other in vain."""
        for end in self.ends:
            end.close()


POOL = {}


def together(function, *args, count=2):
    """Run `function(ranks, *args)` in each of `count` processes that train together; their results."""
    pool = POOL.pop(count, None) or Together(count)
    answers = pool.ask(cloudpickle.dumps((function, args)))
    errors = [f"process {rank}:\n{error}" for rank, (_, error) in enumerate(answers) if error is not None]
    if errors:
        # They may be at different places.
        pool.leave()
        pytest.fail("\n".join(errors))
    POOL[count] = pool
    return [result for result, _ in answers]


def serve(address):
    """Work for the process at the other end of a socket until it closes it."""
    torch.set_num_threads(1)
    register_third_party_plugins()
    connected = socket.socket(socket.AF_UNIX)
    connected.connect(address)
    end = Connection(connected.detach())
    ranks = join_ranks("cpu")
    end.send(ranks.rank)
    while True:
        try:
            function, args = cloudpickle.loads(end.recv_bytes())
        except EOFError:
            os._exit(0)
        faulthandler.dump_traceback_later(PATIENCE_S, exit=True)
        try:
            answer = function(ranks, *args), None
        except BaseException:
            answer = None, traceback.format_exc()
        faulthandler.cancel_dump_traceback_later()
        end.send(answer)


class WanderingEnv(DummyEnv):
    """Part of a world of streams, in which the bear is lost beyond 1.4 and put back at a random place."""

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
