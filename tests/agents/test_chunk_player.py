"""Queues and histories of streams that begin at different times."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import get_policy_class, make_policy_config

from cronos_lerobot.agents.chunk_player import ChunkPlayer, SharedPlayer, make_player, take_rows
from cronos_lerobot.agents.processing import PolicyProcessors


def play(player, seen, ids=None):
    """Actions (k,) on observations (k,)."""
    batch = {"observation.state": torch.tensor(seen, dtype=torch.float32)[:, None], "task": ["go"] * len(seen)}
    return player.act(batch, range(len(seen)) if ids is None else ids)[:, 0].tolist()


def test_a_stream_that_switches_tasks_plans_anew_and_the_other_goes_on():
    """A plan says what was seen when it was made, and how old it is: 5.1 is the second action on seeing 5."""
    planned = []

    def plan(frames):
        (frame,) = frames
        planned.append(frame["observation.state"][:, 0].tolist())
        return frame["observation.state"][:, None] + torch.tensor([0.0, 0.1, 0.2, 0.3])[:, None]

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
    def plan(frames):
        return sum(10**i * frame["observation.state"] for i, frame in enumerate(frames))[:, None]

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
    generator = torch.Generator().manual_seed(1)
    for _ in range(steps):
        yield {
            "observation.state": torch.randn(streams, 4, generator=generator),
            "observation.images.front": torch.rand(streams, 3, 32, 32, generator=generator),
            # As LeRobot's preprocessors leave it.
            "task": ["go"] * streams,
            "action": None,
            "next.reward": 0.0,
        }


@pytest.mark.filterwarnings("ignore:To evaluate in the environment, your VQ-BeT:UserWarning")
@pytest.mark.parametrize("name", TINY)
@torch.no_grad()
def test_streams_in_step_do_what_lerobots_select_action_does(name):
    policy = tiny(name)
    policy.reset()
    torch.manual_seed(5)
    expected = [policy.select_action(dict(batch)) for batch in observations(8, 2)]
    player = make_player(policy)
    torch.manual_seed(5)
    found = [player.act(batch, [0, 1]) for batch in observations(8, 2)]
    torch.testing.assert_close(torch.stack(found), torch.stack(expected), rtol=0, atol=1e-6)
    assert (expected[0] - expected[1]).abs().max() > 1e-4


@torch.no_grad()
def test_a_late_stream_does_what_it_does_alone():
    """ACT: stream 1 begins anew at step 4, in the middle of a chunk."""
    policy = tiny("act")
    seen = list(observations(8, 2))
    player = make_player(policy)
    found = []
    for step, batch in enumerate(seen):
        if step == 4:
            player.begin([1])
        found.append(player.act(batch, [0, 1]))
    for stream, begins in ((0, [0]), (1, [0, 4])):
        for step, batch in enumerate(seen):
            if step in begins:
                policy.reset()
            own = take_rows(batch, [stream])
            torch.testing.assert_close(found[step][stream], policy.select_action(own)[0], rtol=0, atol=1e-5)


def packing(columns, instructions):
    """As Qwen's processors do it: the patches of all pictures one after the other, `count` of each."""
    counts = columns["seen"].astype(int)
    return {
        "count": torch.from_numpy(counts),
        "patches": torch.from_numpy(np.repeat(columns["seen"], counts)),
        "task": instructions,
    }


def test_a_late_stream_gets_its_own_patches():
    """Stream i sees i + 1 patches of the value i + 1, and is planned for alone from step 2 on."""
    planned = []

    def plan(frames):
        (batch,) = frames
        assert len(batch["patches"]) == batch["count"].sum()
        planned.append(batch["patches"].tolist())
        return torch.stack([part.sum() for part in batch["patches"].split(batch["count"].tolist())])[:, None, None]

    processors = PolicyProcessors(lambda batch: packing({"seen": batch["seen"].numpy()}, batch["task"]), None)
    asked = []

    def rows(wanted):
        asked.append(wanted)
        return processors.rows({"seen": np.array([1.0, 2.0, 3.0])}, ["a", "b", "c"])(wanted)

    player = ChunkPlayer(lambda frames: plan(frames).repeat(1, 2, 1))
    assert player.act(rows, [0, 1, 2])[:, 0].tolist() == [1, 4, 9]
    player.begin([1])
    assert player.act(rows, [0, 1, 2])[:, 0].tolist() == [1, 4, 9]
    assert planned == [[1, 2, 2, 3, 3, 3], [2, 2]]
    asked.clear()
    assert player.act(rows, [1])[:, 0].tolist() == [4]
    assert asked == [], "who has actions left is not looked at"
    whole = rows([0, 1, 2])
    assert player.act(whole, [0, 1, 2])[:, 0].tolist() == [1, 4, 9]
    player.begin([2])
    with pytest.raises(ValueError, match=r"'patches' has the shape \(6,\) for 3 observations"):
        player.act(whole, [0, 1, 2])


def test_rows_are_those_of_the_whole_batch():
    """A text is padded to the longest of all streams, whoever plans: a plan is what it was, bit for bit."""

    def preprocess(batch):
        width = max(map(len, batch["task"]))
        return batch | {"tokens": torch.tensor([list(map(ord, text.ljust(width))) for text in batch["task"]])}

    planned = []

    def plan(frames):
        planned.append(frames[0])
        return torch.zeros(len(frames[0]["task"]), 2, 1)

    state = np.arange(6, dtype=np.float32).reshape(3, 2)
    rows = PolicyProcessors(preprocess, None).rows({"observation.state": state}, ["a", "bcd", "ef"])
    player = ChunkPlayer(plan)
    player.act(rows, [0, 1, 2])
    player.begin([0, 2])
    player.act(rows, [0, 1, 2])
    assert planned[1]["tokens"].tolist() == [[97, 32, 32], [101, 102, 32]]
    assert planned[1]["observation.state"].tolist() == [[0, 1], [4, 5]]


def test_groot_plays_as_many_actions_as_it_queues():
    """Its `select_action` queues `_action_queue_steps`, which may be fewer than `n_action_steps`."""
    config = SimpleNamespace(type="groot", n_action_steps=4)
    policy = SimpleNamespace(config=config, _action_queue_steps=2, reset=lambda: None)
    policy.predict_action_chunk = lambda batch: batch["observation.state"][:, None] + torch.arange(4.0)[:, None]
    player = make_player(policy)
    assert [play(player, [seen]) for seen in (0, 10, 20, 30)] == [[0], [1], [20], [21]]


def test_plans_that_depend_on_plans_are_left_to_the_policy():
    config = SimpleNamespace(type="act", temporal_ensemble_coeff=0.01)
    policy = SimpleNamespace(config=config, select_action=lambda batch: batch["x"], resets=[])
    policy.reset = lambda: policy.resets.append(1)
    player = make_player(policy)
    assert isinstance(player, SharedPlayer)
    assert not player.is_per_stream
    assert player.act({"x": 3}, [0]) == 3
    player.begin([])
    assert player.act({"x": 4}, [0]) == 4
    assert len(policy.resets) == 1
    player.begin([1])
    assert player.act(lambda rows: {"x": 5 + len(rows)}, [0]) == 6
    assert len(policy.resets) == 2
    # Its cache of what was seen and done reaches back to the first chunk.
    config.type, config.temporal_ensemble_coeff = "lingbot_va", None
    assert isinstance(make_player(policy), SharedPlayer)
