"""One update of every agent with every policy that it can train, small enough for a test."""

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies import make_pre_post_processors
from test_chunk_player import FEATURES, TINY, tiny
from test_imitation_agent import STEPS, learn
from tiny_pocketvla import make_pocketvla
from tiny_vlas import KINDS, make_processors, make_vla

from cronos_lerobot.agents.builtin import imitation, ppo, steering
from cronos_lerobot.agents.imitation.config import ImitationConfig
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.processing import make_processors as around
from cronos_lerobot.agents.registry import AgentContext, make_agent
from cronos_lerobot.agents.steering.config import SteeringConfig

assert imitation
assert ppo
assert steering
TDMPC = {
    "horizon": 2, "latent_dim": 8, "mlp_dim": 16, "state_encoder_hidden_dim": 8, "image_encoder_hidden_dim": 8,
    "n_action_repeats": 1, "n_gaussian_samples": 8, "n_pi_samples": 2, "n_elites": 4, "cem_iterations": 2,
}  # fmt: skip
CONFIGS = {
    "imitation": ImitationConfig(steps_per_update=2, batch_size=4, warmup_segments=1, ema_decay=0.5),
    "ppo": PPOConfig(value_warmup_updates=0, epochs=1, minibatch_size=8, policy_lr=1e-3, ratio="factor"),
    "steering": SteeringConfig(hidden_width=16, warmup_decisions=1, batch_size=4, utd=1),
}
TRAINS = {
    "imitation": [*TINY, "tdmpc", *KINDS, "gaussian", "categorical", "flow"],
    "ppo": ["act", "diffusion", *KINDS, "gaussian", "categorical", "flow"],
    "steering": ["diffusion", *KINDS, "flow"],
}
"""The last three are PocketVLA's heads."""
ACTING = {"vqbet": "vqbet.policy.", "tdmpc": "model._pi."} | dict.fromkeys(KINDS, "expert.")
"""Part of the names of what acts, where only that part of a policy is looked at."""


@pytest.fixture
def small_tdmpc_and_vqbet(monkeypatch):
    """LeRobot's TD-MPC acts on no picture but `observation.image`. VQ-BeT's first step trains its codes."""
    monkeypatch.setitem(TINY, "tdmpc", TDMPC)
    monkeypatch.setitem(TINY["vqbet"], "n_vqvae_training_steps", 1)


def make(kind, folder, monkeypatch):
    """A policy and its processors."""
    if kind in KINDS:
        policy = make_vla(kind, folder)
        return policy, make_processors(policy, folder)
    if kind == "tdmpc":
        monkeypatch.setitem(FEATURES, "observation.environment_state", PolicyFeature(FeatureType.ENV, (6,)))
        monkeypatch.delitem(FEATURES, "observation.images.front")
    policy = tiny(kind) if kind in TINY else make_pocketvla(kind)
    return policy, make_pre_post_processors(policy.config)


@pytest.mark.usefixtures("small_tdmpc_and_vqbet")
@pytest.mark.filterwarnings("ignore:To evaluate in the environment, your VQ-BeT:UserWarning")
@pytest.mark.parametrize(("agent", "kind"), [(agent, kind) for agent in TRAINS for kind in TRAINS[agent]])
def test_an_update_moves_what_acts(agent, kind, tmp_path, monkeypatch):
    policy, pair = make(kind, tmp_path, monkeypatch)
    frozen = {name for name, param in policy.named_parameters() if not param.requires_grad}
    before = {name: param.detach().clone() for name, param in policy.named_parameters()}
    made = make_agent(
        AgentContext(
            CONFIGS[agent], policy, around(policy, *pair), num_streams=2, update_interval=STEPS,
            task_switch_interval=STEPS, rng=lambda name: np.random.default_rng(0),
            torch_rng=lambda name: torch.Generator().manual_seed(0),
        )
    )  # fmt: skip
    metrics = learn(made)
    assert all(np.isfinite(value) for value in metrics.values())
    moved = {name for name, param in policy.named_parameters() if not torch.equal(param, before[name])}
    # TD-MPC's target network follows the one that is trained.
    assert not {name for name in moved & frozen if "model_target" not in name}
    if agent == "steering":
        assert not moved
        assert metrics["actor_grad_norm"] > 0
    else:
        assert [name for name in moved if ACTING.get(kind, "") in name]
        assert metrics["policy_grad_norm" if agent == "ppo" else "grad_norm"] > 0
    assert not policy.training
