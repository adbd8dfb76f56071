"""A checkpoint that has an actor beside its policy is played with that actor."""

import numpy as np
import torch
from lerobot.policies import get_policy_class, make_pre_post_processors
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.agents.adapters.registry import make_steerable
from cronos_lerobot.agents.steering.steered import STEERING, SteeredPolicy, SteeringShape
from cronos_lerobot.evaluation.actors import load_actor
from cronos_lerobot.evaluation.policy_source import load_policy_config


def test_a_steered_checkpoint_is_played_steered(tmp_path):
    options = {"hidden_width": 16, "hidden_depth": 1, "flow_width": 16, "flow_depth": 1}
    save_policy(tmp_path, "pocketvla", STATE, head="flow", chunk_size=4, n_action_steps=2, **options)
    policy = get_policy_class("pocketvla").from_pretrained(tmp_path)
    steerable = make_steerable(policy)
    env = CronosVectorEnv(1, **STATE)
    observation, instructions = env.observe(), env.instructions
    env.close()
    columns = {"observation.state": "agent_pos", "observation.environment_state": "environment_state"}
    raw = {name: torch.from_numpy(observation[key]).float() for name, key in columns.items()}
    before, after = make_pre_post_processors(policy.config, str(tmp_path))
    batch = before(raw | {"task": instructions})
    shape = SteeringShape(steerable.observe(batch)[1].shape[1], "policy", 1.5, True, 8)
    steered = SteeredPolicy(steerable, shape)
    with torch.no_grad():
        # Whatever it sees, it chooses the greatest noise: tanh(20) = 1, with a deviation of e^-5 before tanh.
        steered.actor.head.bias[:7], steered.actor.head.bias[7:] = 20.0, -5.0
        expected = after(policy.predict_action_chunk(batch, noise=torch.full((1, 4, 7), 1.5)).flatten(0, 1))
    assert not plays(tmp_path, observation, instructions, expected)
    steered.save_pretrained(tmp_path)
    assert (tmp_path / STEERING).is_file()
    assert plays(tmp_path, observation, instructions, expected)


def plays(folder, observation, instructions, expected):
    """Whether a checkpoint plays the first two steps of `expected`, a chunk of four, (4, 7)."""
    config = load_policy_config(folder, ["--device=cpu"])
    actor, streams = load_actor(config, CronosEnvConfig(**STATE), temperature=0.6), np.arange(1)
    actor.seed(3)
    actor.begin(streams, [(3, 0)])
    played = np.concatenate([actor.act(observation, instructions, streams).action for _ in range(2)])
    return np.allclose(played, expected[:2], rtol=0, atol=1e-5)
