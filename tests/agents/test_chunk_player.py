"""Queues and histories of streams that begin at different times."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from dummies import identity_processors
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config

from cronos_lerobot.agents.chunk_player import ChunkPlayer, SharedPlayer, make_player
from cronos_lerobot.agents.processing import PolicyProcessors
from cronos_lerobot.evaluation.actors import SelectingPolicy


def play(player, seen, ids=None):
    """Actions (k,) on observations (k,)."""
    columns = {"observation.state": np.array(seen, np.float32)[:, None]}
    return player.act(columns, ["go"] * len(seen), range(len(seen)) if ids is None else ids)[:, 0].tolist()


def test_a_stream_that_switches_tasks_plans_anew_and_the_other_goes_on():
    """A plan says what was seen when it was made, and how old it is: 5.1 is the second action on seeing 5."""
    planned = []

    def plan(columns, instructions):
        assert len(instructions) == len(columns["observation.state"])
        planned.append(columns["observation.state"][:, 0].tolist())
        return torch.from_numpy(columns["observation.state"])[:, None] + torch.tensor([0, 0.1, 0.2, 0.3])[:, None]

    player = ChunkPlayer(plan, num_steps=3)
    assert play(player, [5, 6]) == [5, 6]
    assert play(player, [15, 16]) == pytest.approx([5.1, 6.1])
    player.begin([1])
    assert play(player, [25, 26]) == pytest.approx([5.2, 26])
    assert play(player, [35, 36]) == pytest.approx([35, 26.1])
    # A stream that is not asked for stays where it is.
    assert play(player, [46], ids=[1]) == pytest.approx([26.2])
    assert play(player, [55, 56]) == pytest.approx([35.1, 56])
    assert planned == [[5, 6], [26], [35], [56]]


def test_history_is_each_streams_own():
    def plan(columns, instructions):
        return torch.from_numpy(columns["observation.state"][..., 0] @ [1, 10, 100])[:, None, None]

    player = ChunkPlayer(plan, history=3)
    # The newest counts hundreds; before the first observation it is the first one over and over.
    assert play(player, [1, 2]) == [111, 222]
    assert play(player, [3, 4]) == [311, 422]
    player.begin([0])
    assert play(player, [5, 6]) == [555, 642]
    assert play(player, [7, 8]) == [755, 864]


TINY = {
    "act": {
        "chunk_size": 6, "n_action_steps": 3, "dim_model": 16, "n_heads": 2, "dim_feedforward": 32,
        "n_encoder_layers": 1, "n_decoder_layers": 1, "use_vae": False, "pretrained_backbone_weights": None,
    },
    "diffusion": {
        "n_obs_steps": 2, "horizon": 8, "n_action_steps": 3, "down_dims": [16, 32], "n_groups": 4,
        "diffusion_step_embed_dim": 8, "num_inference_steps": 2, "noise_scheduler_type": "DDIM",
        "drop_n_last_frames": 4, "pretrained_backbone_weights": None, "use_group_norm": True,
        "spatial_softmax_num_keypoints": 4,
    },
    "vqbet": {
        "n_obs_steps": 3, "n_action_pred_token": 2, "action_chunk_size": 3, "gpt_n_layer": 1, "gpt_n_head": 2,
        "gpt_hidden_dim": 16, "gpt_input_dim": 16, "gpt_output_dim": 16, "vqvae_n_embed": 4,
        "vqvae_embedding_dim": 8, "vqvae_enc_hidden_dim": 8, "crop_shape": (32, 32), "offset_loss_weight": 1.0,
        "spatial_softmax_num_keypoints": 4, "pretrained_backbone_weights": None, "use_group_norm": True,
    },
}  # fmt: skip
FEATURES = {
    "observation.state": PolicyFeature(FeatureType.STATE, (4,)),
    "observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 32, 32)),
}


def tiny(name):
    config = make_policy_config(name, device="cpu", **TINY[name])
    config.input_features, config.output_features = (
        dict(FEATURES),
        {"action": PolicyFeature(FeatureType.ACTION, (7,))},
    )
    torch.manual_seed(0)
    return get_policy_class(name)(config).eval()


def observations(steps, streams):
    rng = np.random.default_rng(1)
    for _ in range(steps):
        yield {
            "observation.state": rng.normal(size=(streams, 4)).astype(np.float32),
            "observation.images.front": rng.integers(256, size=(streams, 32, 32, 3), dtype=np.uint8),
        }


def make_processors():
    # As LeRobot's preprocessors leave it.
    return PolicyProcessors(lambda batch: batch | {"action": None, "next.reward": 0.0}, lambda action: action)


@pytest.mark.filterwarnings("ignore:To evaluate in the environment, your VQ-BeT:UserWarning")
@pytest.mark.parametrize("name", TINY)
@torch.no_grad()
def test_streams_in_step_do_what_lerobots_select_action_does(name):
    policy, processors = tiny(name), make_processors()
    policy.reset()
    torch.manual_seed(5)
    expected = [policy.select_action(processors.batch(seen, ["go"] * 2)) for seen in observations(8, 2)]
    player = make_player(policy, processors)
    torch.manual_seed(5)
    found = [player.act(seen, ["go"] * 2, [0, 1]) for seen in observations(8, 2)]
    torch.testing.assert_close(torch.stack(found), torch.stack(expected), rtol=0, atol=1e-6)
    assert (expected[0] - expected[1]).abs().max() > 1e-4


def test_an_evaluation_plans_anew_where_a_task_begins():
    class Planner(torch.nn.Module):
        """Sees one number, and plans to play it three times."""

        config = SimpleNamespace(type="planner", use_amp=False)

        def reset(self):
            pass

        def predict_action_chunk(self, batch):
            return batch["observation.state"][:, None].expand(-1, 3, 7)

    actor = SelectingPolicy(Planner(), PolicyProcessors(*identity_processors()), (dict, dict))

    def act(*numbers):
        observation = {"agent_pos": np.array(numbers, np.float32)[:, None]}
        return actor.act(observation, ["go"] * 2, np.arange(2)).action[:, 0].tolist()

    assert actor.is_per_stream
    assert act(1, 2) == [1, 2]
    actor.begin(np.array([1]))
    assert act(3, 4) == [1, 4]


def test_plans_that_depend_on_plans_are_left_to_the_policy():
    config = SimpleNamespace(type="act", temporal_ensemble_coeff=0.01)
    policy = SimpleNamespace(config=config, select_action=lambda batch: batch["observation.state"], resets=[])
    policy.reset = lambda: policy.resets.append(1)
    processors = PolicyProcessors(*identity_processors())
    player = make_player(policy, processors)
    assert isinstance(player, SharedPlayer)
    assert not player.is_per_stream
    assert play(player, [3]) == [3]
    player.begin([])
    assert play(player, [4]) == [4]
    assert len(policy.resets) == 1
    player.begin([1])
    assert play(player, [5]) == [5]
    assert len(policy.resets) == 2
    # Its cache of what was seen and done reaches back to the first chunk.
    config.type, config.temporal_ensemble_coeff = "lingbot_va", None
    assert isinstance(make_player(policy, processors), SharedPlayer)
