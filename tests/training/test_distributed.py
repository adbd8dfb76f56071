"""Two processes that train together, against one process with all of their streams."""

import io
import json
import os
import random
import re
import signal
import sys
from contextlib import redirect_stdout
from unittest.mock import patch

import numpy as np
import pytest
import torch
from dummies import TASKS, DummyEnv, DummyPolicy
from forked_commands import run_forked
from forked_processes import ScriptedPolicy, WanderingEnv, together
from lerobot.datasets import LeRobotDataset
from lerobot_env_cronos import CronosEnvConfig
from runs import STEPS_PER_UPDATE, STREAMS, KilledError, assert_same_run, config, make_trainer, metrics
from test_cronos_train import OBSERVATIONS, SMALL

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.task_orders import TASK_ORDERS
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.scripts import train as train_script
from cronos_lerobot.stopwatch import Stopwatch
from cronos_lerobot.training.config import CronosTrainConfig, RecordConfig
from cronos_lerobot.training.factory import make_env
from cronos_lerobot.training.sharding import ShardedEnv
from cronos_lerobot.training.stopping import StopRequest


def train(ranks, cfg, policy_class=ScriptedPolicy, dies_at=None):
    """Train in this process; returns what all processes should agree on, or None if it died."""
    mine = ranks.share_of(cfg.num_envs)
    env = WanderingEnv(mine.stop - mine.start, mine.start, dies_at)
    # The processes begin with the weights of the first one.
    policy = policy_class(seed=ranks.rank)
    trainer = make_trainer(cfg, env, policy, ranks)
    try:
        trainer.train()
    except KilledError:
        return None
    parameters = torch.cat([parameter.detach().flatten() for parameter in policy.parameters()])
    return trainer.loop.state_dict(), parameters.tolist()


def settings(folder, minibatch_size, *, resume=None, budget=None, task_order="random", algorithm=None, **options):
    """A run with heuristic resets; `minibatch_size` is that of one process."""
    protocol = ProtocolConfig(
        task_switch_interval=4, update_interval=8, scene_reset_interval=16, heuristic_reset=True,
        task_order=task_order, reset_budget=budget,
    )  # fmt: skip
    ppo = {"minibatch_size": minibatch_size, "policy_lr": 1e-2, "policy_lr_max": 1.0, "kl_base_coef": 0.1} | (
        algorithm or {}
    )
    cfg = config(folder, protocol=protocol, algorithm=PPOConfig(**ppo), **options)
    cfg.checkpoint_path = resume
    return cfg


def columns(folder):
    data = LeRobotDataset("me/stream", root=folder / "streams").hf_dataset.with_format("numpy")[:]
    order = np.lexsort([data["cronos.step"], data["cronos.stream_id"]])
    return {name: column[order] for name, column in data.items() if name.startswith(("cronos", "action", "obs"))}


# At a policy_lr of 0.3 the updates stop early.
@pytest.mark.parametrize("algorithm", [{}, {"policy_lr": 0.3, "lr_schedule": "kl_step"}], ids=["", "early_stop"])
def test_two_processes_are_one_run(tmp_path, algorithm):
    """Counters, draws, logs, recordings, evaluations and, but for rounding, the policy."""
    options = {"record": RecordConfig(repo_id="me/stream", streams="all"), "algorithm": algorithm}
    loop, policy = train(Ranks(), settings(tmp_path / "one", 32, **options))
    answers = together(train, settings(tmp_path / "two", 16, **options))
    assert answers[0] == answers[1]
    assert answers[0][0] == loop
    assert answers[0][1] == pytest.approx(policy, rel=1e-3, abs=1e-5)
    one, two = metrics(tmp_path / "one"), metrics(tmp_path / "two")
    for a, b in zip(one, two, strict=True):
        assert a.pop("agent", {}) == pytest.approx(b.pop("agent", {}), rel=1e-3, abs=1e-5)
        assert a == b
    first, second = columns(tmp_path / "one"), columns(tmp_path / "two")
    assert first["cronos.stream_id"].tolist() == np.repeat(range(STREAMS), 32).tolist()
    for name, column in first.items():
        np.testing.assert_allclose(second[name], column, rtol=1e-3, atol=1e-5, err_msg=name)


def test_resumed_run_of_two_processes_equals_the_unbroken_one(tmp_path):
    """With actions and minibatches of chance, which differ between the processes."""
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    answers = together(train, settings(unbroken, 4), DummyPolicy)
    assert together(train, settings(broken, 4), DummyPolicy, 21) == [None, None]
    checkpoint = (broken / "checkpoints/last").resolve()
    assert checkpoint.name == f"{2 * STEPS_PER_UPDATE:06d}"
    assert together(train, settings(broken, 4, resume=checkpoint), DummyPolicy) == answers
    assert_same_run(unbroken, broken)
    starts = json.loads((broken / "manifest.json").read_text())["starts"]
    assert [start["num_processes"] for start in starts] == [2, 2]


def test_a_run_of_two_processes_goes_on_in_one(tmp_path, caplog):
    together(train, settings(tmp_path / "run", 16, steps=2 * STEPS_PER_UPDATE))
    resumed = settings(tmp_path / "run", 32, resume=(tmp_path / "run/checkpoints/last").resolve())
    loop, policy = train(Ranks(), resumed)
    assert "of 2 processes, this run has 1" in caplog.text
    expected, weights = train(Ranks(), settings(tmp_path / "one", 32))
    assert loop == expected
    assert policy == pytest.approx(weights, rel=1e-3, abs=1e-5)


def first_draws(ranks, cfg):
    """What Python's, NumPy's and PyTorch's own generators give after the run's checkpoint was loaded."""
    mine = ranks.share_of(cfg.num_envs)
    make_trainer(cfg, WanderingEnv(mine.stop - mine.start, mine.start), ScriptedPolicy(), ranks)
    return random.random(), float(np.random.random()), float(torch.rand(1))


def test_a_process_that_joins_a_resumed_run_has_random_numbers_of_its_own(tmp_path):
    """The same ones each time; the first process goes on with the run's."""
    train(Ranks(), settings(tmp_path / "run", 32, steps=2 * STEPS_PER_UPDATE))
    resumed = settings(tmp_path / "run", 16, resume=(tmp_path / "run/checkpoints/last").resolve())
    alone = first_draws(Ranks(), resumed)
    first, second = together(first_draws, resumed)
    assert first == alone
    assert all(one != other for one, other in zip(first, second, strict=True))
    assert together(first_draws, resumed) == [first, second]
    joins = int(np.random.SeedSequence([5, 1, 2 * STEPS_PER_UPDATE]).generate_state(1)[0])
    assert second[0] == random.Random(joins).random()


class SignallingEnv(WanderingEnv):
    """Has its process told to stop in the middle of a segment."""

    def step(self, actions):
        if self.t == 13:
            signal.raise_signal(signal.SIGTERM)
        return super().step(actions)


def stopped(ranks, cfg):
    """Train until it ends; whether that is the run's end, the signal of this process, and the steps done."""
    mine = ranks.share_of(cfg.num_envs)
    env = (SignallingEnv if ranks.rank == 1 else WanderingEnv)(mine.stop - mine.start, mine.start)
    trainer = make_trainer(cfg, env, ScriptedPolicy(), ranks)
    with StopRequest() as stop:
        return trainer.train(stop), stop.number, trainer.loop.n


def test_one_process_that_is_told_to_stop_stops_both(tmp_path):
    cfg = settings(tmp_path / "run", 16, save_freq=4 * STEPS_PER_UPDATE)
    steps = 2 * STEPS_PER_UPDATE
    assert together(stopped, cfg) == [(False, None, steps), (False, signal.SIGTERM, steps)]
    assert (tmp_path / "run/checkpoints/last").resolve().name == f"{steps:06d}"


def test_every_process_draws_its_own_actions(tmp_path):
    def first_actions(ranks, cfg):
        mine = ranks.share_of(cfg.num_envs)
        run = make_trainer(cfg, DummyEnv(mine.stop - mine.start), DummyPolicy(), ranks).run
        tau = [TASKS[0].instruction] * cfg.num_envs
        return run.agent.act(run.env.observe(), tau).action.tolist()

    tokens = together(first_actions, settings(tmp_path / "run", 16))
    assert np.shape(tokens) == (2, 2, 7)
    assert tokens[0] != tokens[1]


def test_mean_of_gradients_by_hand():
    """In buckets of two numbers; the last parameter is used by the second process only, the one before by none."""

    @patch("cronos_lerobot.ranks.BUCKET_BYTES", 8)
    def average(ranks):
        rank = ranks.rank
        parameters = [torch.zeros(2), torch.zeros(1), torch.zeros(3).bfloat16(), torch.zeros(1), torch.zeros(1)]
        grads = [
            torch.tensor([1.0, 2.0]) + rank, torch.full((1,), 4.0 * rank), torch.full((3,), 1.0 - rank).bfloat16(),
            None, torch.tensor([6.0]) if rank else None,
        ]  # fmt: skip
        for parameter, grad in zip(parameters, grads, strict=True):
            parameter.grad = grad
        ranks.average_gradients(parameters)
        return [None if p.grad is None else p.grad.tolist() for p in parameters]

    assert together(average) == [[[1.5, 2.5], [2.0], [0.5, 0.5, 0.5], None, [3.0]]] * 2


def test_a_task_order_that_decides_by_itself_is_stopped(tmp_path, monkeypatch):
    class Alone:
        def __init__(self, rng):
            self.rng = np.random.default_rng(os.getpid())

        def draw(self, loop):
            return self.rng.integers(loop.num_tasks, size=loop.num_streams)

    @patch.dict("cronos_lerobot.protocol.task_orders.TASK_ORDERS", alone=Alone)
    def train_alone(ranks, cfg):
        with pytest.raises(RuntimeError, match="the loop's state"):
            train(ranks, cfg)

    monkeypatch.setitem(TASK_ORDERS, "alone", Alone)
    together(train_alone, settings(tmp_path / "run", 16, task_order="alone"))


def test_help_is_known_in_all_processes_and_actions_where_they_were_executed():
    class Helped(DummyEnv):
        def step(self, actions):
            *outcome, info = super().step(actions)
            return *outcome, info | {
                "executed_action": actions + 1,
                "intervened": np.array([False, self.x[0] > 1]),
            }

    def step(ranks):
        env = Helped(2)
        env.timer = Stopwatch()
        env.x[:] = 2 * ranks.rank
        *_, info = ShardedEnv(env, ranks).step(np.full((2, 7), ranks.rank, np.float32))
        return info["intervened"].tolist(), info["executed_action"][:, 0].tolist()

    assert together(step) == [([False, False, False, True], [n, n]) for n in (1, 2)]


def test_streams_that_cannot_be_shared_out_are_refused():
    ranks = Ranks()
    ranks.count = 3
    with pytest.raises(ValueError, match="num_envs"):
        ranks.share_of(64)


@pytest.mark.parametrize(("num_threads", "local_processes", "expected"), [(0, 3, 2), (0, 12, 1), (4, 3, 4)])
def test_processes_share_the_cores_of_their_node(num_threads, local_processes, expected, monkeypatch):
    # Of those that it may use, on a node of more.
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(6)))
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    scene = CronosEnvConfig(obs_type="environment_state_agent_pos", num_threads=num_threads)
    env = make_env(CronosTrainConfig(env=scene), 8, local_processes)
    assert env.simulation._batch.nthread == expected
    env.close()


def command(ranks, flags):
    """`cronos-train` in this process; what it prints."""
    with (
        patch.object(sys, "argv", ["cronos-train", *flags]),
        patch.object(train_script, "join_ranks", lambda device: ranks),
        patch.object(ranks, "leave"),
        redirect_stdout(io.StringIO()) as said,
    ):
        train_script.main()
    return said.getvalue()


def test_the_command_in_two_processes(tmp_path):
    folder = tmp_path / "run"
    flags = [*SMALL, *OBSERVATIONS["state"], "--num_envs=4", "--steps=64", f"--output_dir={folder}"]
    first, second = together(command, flags)
    assert re.findall(r"^(\d+)/64 steps", first, re.MULTILINE) == ["32", "64"]
    assert second == ""
    updates = metrics(folder)
    assert [line["interaction_steps"] for line in updates] == [32, 64]
    # Sixteen steps of four streams, T = 8.
    assert updates[-1]["interventions_by_kind"]["scene_reset"] == 8
    assert updates[-1]["interventions_by_kind"]["end_effector_reset"] == 16
    (start,) = json.loads((folder / "manifest.json").read_text())["starts"]
    assert start["num_processes"] == 2


def test_accelerate_launch_says_what_the_processes_join_by():
    """The command of docs/scale.md, with `env` in place of `cronos-train`: it says what `Together` does."""
    launch = [
        sys.executable, "-m", "accelerate.commands.launch", "--multi_gpu", "--num_processes=2", "--num_machines=1",
        "--main_process_port=0", "--mixed_precision=no", "--dynamo_backend=no", "--no_python", "env",
    ]  # fmt: skip
    done = run_forked(launch)
    assert done.returncode == 0, done.stderr[-3000:]

    def said(name):
        return sorted(re.findall(rf"^{name}=(.*)$", done.stdout, re.MULTILINE))

    assert said("RANK") == said("LOCAL_RANK") == ["0", "1"]
    assert said("WORLD_SIZE") == said("LOCAL_WORLD_SIZE") == ["2", "2"]
    assert len(set(said("MASTER_PORT"))) == len(set(said("MASTER_ADDR"))) == 1
