import numpy as np
import pytest
import torch
from dummies import DummyPolicy, DummyPolicyConfig, identity_processors
from lerobot.configs import NormalizationMode
from lerobot.envs.utils import preprocess_observation
from lerobot.processor import PolicyProcessorPipeline, RelativeActionsProcessorStep, TokenizerProcessorStep

from cronos_lerobot.agents.processing import PolicyProcessors, make_processors, observation_columns


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


@pytest.mark.parametrize(
    ("takes_uint8", "mode", "expected"),
    [
        # pi0, pi05 and SmolVLA leave images alone and expect [0, 1].
        (False, NormalizationMode.IDENTITY, torch.float32),
        (True, NormalizationMode.IDENTITY, torch.uint8),
        (True, NormalizationMode.MEAN_STD, torch.float32),
    ],
)
def test_only_a_policy_that_says_so_gets_uint8_images(takes_uint8, mode, expected):
    config = DummyPolicyConfig()
    config.normalization_mapping = {"VISUAL": mode}
    policy = DummyPolicy(config)
    policy.takes_uint8_images = takes_uint8
    batch = make_processors(policy, *identity_processors()).batch(observation_columns(observation()), ["a", "b"])
    images = batch["observation.images.front"]
    assert images.dtype == expected
    assert images.max() > 200 if takes_uint8 and expected == torch.uint8 else images.max() <= 1


class CountingTokenizer:
    """A token for each letter, padded to the longest text, as Hugging Face's tokenizers return them."""

    def __init__(self):
        self.texts = []

    def __call__(self, texts, **options):
        self.texts += texts
        longest = max(map(len, texts))
        ids = [[ord(letter) for letter in text] + [0] * (longest - len(text)) for text in texts]
        return {"input_ids": torch.tensor(ids), "attention_mask": (torch.tensor(ids) > 0).long()}


def test_each_instruction_of_a_batch_is_tokenized_once():
    tokenizer = CountingTokenizer()
    pipeline = PolicyProcessorPipeline(steps=[TokenizerProcessorStep(tokenizer=tokenizer)])
    columns = {"observation.state": np.zeros((5, 2), np.float32)}
    batch = make_processors(DummyPolicy(), pipeline, identity_processors()[1]).batch(columns, [*"aba", "cc", "b"])
    assert tokenizer.texts == ["a", "b", "cc"]
    expected = [[97, 0], [98, 0], [97, 0], [99, 99], [98, 0]]
    assert batch["observation.language.tokens"].tolist() == expected
    assert batch["observation.language.attention_mask"].tolist() == [[bool(i) for i in row] for row in expected]


def test_a_history_is_preprocessed_observation_by_observation():
    def preprocess(batch):
        letters = torch.tensor([[len(text)] for text in batch["task"]])
        renamed = {"observation.renamed": 2 * batch.pop("observation.state")}
        return batch | renamed | {"observation.language.tokens": letters, "action": None}

    processors = PolicyProcessors(preprocess, lambda action: action)
    rng = np.random.default_rng(1)
    pixels = rng.integers(0, 256, (2, 3, 8, 6, 3), dtype=np.uint8)
    columns = {
        "observation.images.front": pixels,
        "observation.state": rng.normal(size=(2, 3, 4)).astype(np.float32),
    }
    batch = processors.batch(columns, ["put it", "there"])
    assert batch["task"] == ["put it", "there"]
    assert batch["observation.language.tokens"].tolist() == [[6], [5]]
    assert batch["action"] is None
    for step in range(3):
        alone = processors.batch({name: col[:, step] for name, col in columns.items()}, ["put it", "there"])
        for name in ("observation.images.front", "observation.renamed"):
            assert torch.equal(batch[name][:, step], alone[name])


def test_relative_actions_are_refused():
    """By the flag, and by what a checkpoint's preprocessor does."""
    config = DummyPolicyConfig()
    policy, (preprocessor, postprocessor) = DummyPolicy(config), identity_processors()
    message = (
        r"--policy\.type=dummy_linear with --policy\.use_relative_actions=true plays .*: clone the policy with"
    )
    for is_enabled in (False, True):
        steps = [RelativeActionsProcessorStep(enabled=is_enabled)]
        relative = PolicyProcessorPipeline(steps=steps)
        if is_enabled:
            with pytest.raises(ValueError, match=message):
                make_processors(policy, relative, postprocessor)
        else:
            make_processors(policy, relative, postprocessor)
    config.use_relative_actions = True
    with pytest.raises(ValueError, match=message):
        make_processors(policy, preprocessor, postprocessor)
