"""Tiny runs with a dummy environment and policy, and what two runs are compared by."""

import json

import torch
from dummies import DummyEnv, DummyPolicy, DummyPolicyConfig, identity_processors
from lerobot.utils.random_utils import set_seed
from safetensors.torch import load_file

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.ranks import Ranks
from cronos_lerobot.training.checkpoint import read_state
from cronos_lerobot.training.config import CronosTrainConfig, PeriodicEvaluationConfig
from cronos_lerobot.training.run import Parts, Run
from cronos_lerobot.training.trainer import Trainer

VOLATILE = ("time", "time_share", "steps_per_s")
STREAMS = 4
STEPS_PER_UPDATE = 4 * 8
DIVERGES = {(5, 1), (21, 2)}
"""Step and stream: of two processes the first one has stream 1, the second one stream 2."""


def config(folder, steps=4 * STEPS_PER_UPDATE, **options):
    """Four updates; evaluated after every second one and saved after every one."""
    defaults = {
        "policy": DummyPolicyConfig(),
        "output_dir": folder,
        "num_envs": STREAMS,
        "steps": steps,
        "seed": 5,
        "protocol": ProtocolConfig(
            task_switch_interval=4, update_interval=8, scene_reset_interval=16, task_order="random"
        ),
        "algorithm": PPOConfig(minibatch_size=16, policy_lr=1e-2, policy_lr_max=1.0, kl_base_coef=0.1),
        "eval": PeriodicEvaluationConfig(n_episodes=3, batch_size=5),
        "eval_freq": 2 * STEPS_PER_UPDATE,
        "save_freq": STEPS_PER_UPDATE,
        "tensorboard": False,
    }
    return CronosTrainConfig(**(defaults | options))


def resumed(folder, checkpoint="last", **options):
    """The config of a run that resumes in `folder`."""
    cfg = config(folder, **options)
    cfg.checkpoint_path = (folder / "checkpoints" / checkpoint).resolve()
    return cfg


def make_trainer(cfg, env=None, policy=None, ranks=None):
    """A trainer; a policy of another seed must come from the checkpoint."""
    set_seed(cfg.seed)
    policy = policy or DummyPolicy(seed=8 if cfg.checkpoint_path else 0)
    parts = Parts(env or DummyEnv(STREAMS, diverge_at=DIVERGES), DummyEnv, policy, *identity_processors())
    if ranks is not None:
        parts.ranks = ranks
    return Trainer(Run(cfg, parts), read_state(cfg.checkpoint_path) if cfg.checkpoint_path else None)


def train(cfg, **options):
    """Train to the end; returns the trainer."""
    trainer = make_trainer(cfg, **options)
    trainer.train()
    return trainer


def metrics(folder, kind=None):
    """The lines of metrics.jsonl without what no two runs have in common, of one kind or all."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    lines = [line for line in lines if kind in (None, line["kind"])]
    return [{k: v for k, v in line.items() if k not in VOLATILE} for line in lines]


def weights(folder):
    """Of the last checkpoint."""
    return load_file(folder / "checkpoints/last/pretrained_model/model.safetensors")


def assert_same_weights(a, b):
    first, second = weights(a), weights(b)
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        assert torch.equal(tensor, second[name]), name


def plain(tree):
    """Nested dicts and lists with tensors and arrays as what `==` compares bit for bit."""
    if isinstance(tree, dict):
        return {key: plain(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [plain(value) for value in tree]
    return (str(tree.dtype), tree.tolist()) if hasattr(tree, "dtype") else tree


def assert_same_run(a, b):
    """Bit for bit: metrics, weights and everything in the last state but the place of the folder."""
    assert metrics(a) == metrics(b)
    assert_same_weights(a, b)
    states = [read_state(folder / "checkpoints/last") for folder in (a, b)]
    for state in states:
        state["config"].pop("output_dir")
        # The bytes of metrics.jsonl differ by its times.
        state["observers"].pop("logger")
    for name in states[0]:
        assert plain(states[0][name]) == plain(states[1][name]), name


def train_share(cfg, policy, env_class=DummyEnv, ranks=None):
    """Train with the streams of this process; returns the trainer, or None if the run was killed."""
    ranks = ranks or Ranks()
    mine = ranks.share_of(cfg.num_envs)
    trainer = make_trainer(cfg, env_class(mine.stop - mine.start, diverge_at={(5, 1)}), policy, ranks)
    try:
        trainer.train()
    except KilledError:
        return None
    return trainer


class KilledError(Exception):
    """Ends a run as a kill does."""


class MortalEnv(DummyEnv):
    """Dies in the middle of a segment."""

    def step(self, actions):
        if self.t == 21:
            raise KilledError
        return super().step(actions)


def killed(cfg):
    """Train until a kill in the third of four updates."""
    try:
        train(cfg, env=MortalEnv(STREAMS, diverge_at=DIVERGES))
    except KilledError:
        return
    raise AssertionError("the run ended by itself")
