import numpy as np
import torch
from dummies import identity_processors
from lerobot.envs.utils import preprocess_observation

from cronos_lerobot.agents.processing import PolicyProcessors, observation_columns


def observation():
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (2, 8, 6, 3), dtype=np.uint8)
    return {"pixels": {"front": pixels}, "agent_pos": rng.normal(size=(2, 4)).astype(np.float32)}


def test_batch_equals_lerobots_own():
    ours = PolicyProcessors(*identity_processors()).batch(observation_columns(observation()), ["a", "b"])
    theirs = preprocess_observation(observation())
    assert ours["task"] == ["a", "b"]
    for name, tensor in theirs.items():
        assert torch.equal(ours[name], tensor), name


def test_uint8_images_are_the_same_ones():
    columns = observation_columns(observation())
    floats = PolicyProcessors(*identity_processors()).batch(columns, ["a", "b"])
    integers = PolicyProcessors(*identity_processors(), uint8_images=True).batch(columns, ["a", "b"])
    key = "observation.images.front"
    assert integers[key].dtype == torch.uint8
    assert torch.equal(integers[key].float() / 255, floats[key])
