"""Action tokens, statistics, prompts, images and the token distribution, against numbers worked out by hand."""

import math

import numpy as np
import pytest
import torch
from lerobot_policy_openvla.action_statistics import ActionStatisticsProcessorStep, choose_statistics
from lerobot_policy_openvla.action_tokens import ActionTokenizer, TokenDistribution
from lerobot_policy_openvla.architecture import Architecture
from lerobot_policy_openvla.images import centre_crop, prepare_images
from lerobot_policy_openvla.prompt import PromptTokenizer
from PIL import Image
from published_checkpoint import BRIDGE, MEANS, OTHER, STDS

LLAMA = ActionTokenizer(32000, 256)


def test_tokens_of_actions():
    """Bin edges are -1 + 2 i / 255: the first bin is token 31999, 0 is in the middle of bin 127."""
    actions = torch.tensor([-7.0, -1.0, -1 + 1.9 / 255, -1 + 2.1 / 255, 0.0, 0.9999, 1.0, 7.0])
    assert LLAMA.encode(actions).tolist() == [31999, 31999, 31999, 31998, 31872, 31745, 31744, 31744]


def test_actions_of_tokens():
    tokens = torch.tensor([31999, 31998, 31872, 31745, 31744])
    expected = [-1 + 1 / 255, -1 + 3 / 255, 0.0, 1 - 1 / 255, 1 - 1 / 255]
    np.testing.assert_allclose(LLAMA.decode(tokens), expected, atol=1e-7)


def test_physical_actions():
    """0.5 (v + 1)(q99 - q01) + q01 for the arm; the gripper, which the mask leaves out, is v itself."""
    fields = {name: BRIDGE[name] for name in ("q01", "q99", "mask")}
    v = torch.tensor([[-1.0, 1.0, 0.0, 0.5, -0.5, -1 + 1 / 255, 0.6]])
    dz = 0.5 * 0.066255445406  # half of q99 - q01, above q01 = -0.026093858778
    expected = [[-0.0287272531, 0.0408552546, dz - 0.0260938588, 0.0412101780, -0.0501831200, -0.2063769, 0.6]]
    physical = ActionStatisticsProcessorStep(**fields, inverse=True).convert(v)
    np.testing.assert_allclose(physical, expected, atol=1e-6)
    np.testing.assert_allclose(ActionStatisticsProcessorStep(**fields).convert(physical), v, atol=1e-5)
    far = ActionStatisticsProcessorStep(**fields).convert(torch.tensor([[9.0] * 7]))
    assert far.tolist() == [[1.0] * 7]


def test_choice_of_statistics():
    published = {"bridge_orig": BRIDGE, "other": OTHER}
    unused = {"unused": [False] * 7}
    assert choose_statistics(None, {"other": OTHER}, None) == {"key": "other"} | OTHER | unused
    stats = {"action": {"min": np.array([0.0, 2.0]), "max": np.array([1.0, 3.0])}}
    expected = {"key": "dataset", "q01": [0.0, 2.0], "q99": [1.0, 3.0], "mask": [True, False]}
    expected["unused"] = [False, False]
    assert choose_statistics("dataset", {}, stats) == expected
    with pytest.raises(ValueError, match=r"'fractal'.*bridge_orig.*dataset"):
        choose_statistics("fractal", published, None)
    with pytest.raises(ValueError, match="lerobot-train"):
        choose_statistics("dataset", published, None)
    with pytest.raises(ValueError, match=r"not given.*\['bridge_orig', 'other'\]"):
        choose_statistics(None, published, None)


def test_dimensions_that_never_change():
    """Of four: one that moves, one that never does, one that rarely does (only q01 = q99), a still gripper."""
    stats = {
        "q01": [-2.0, 0.25, 0.0, 1.0], "q99": [2.0, 0.25, 0.0, 1.0], "mask": [True, True, True, False],
        "min": [-2.0, 0.25, -1.0, 1.0], "max": [2.0, 0.25, 1.0, 1.0],
    }  # fmt: skip
    chosen = choose_statistics("mine", {"mine": stats}, None)
    assert chosen["unused"] == [False, True, False, True]
    fields = {name: chosen[name] for name in ("q01", "q99", "mask", "unused")}
    physical = ActionStatisticsProcessorStep(**fields, inverse=True).convert(torch.tensor([[0.5, 0.5, -1.0, 0.9]]))
    np.testing.assert_allclose(physical, [[1.0, 0.25, 0.0, 0.9]], atol=1e-6)
    step = ActionStatisticsProcessorStep(**fields)
    actions = torch.tensor([[1.0, 0.25, 0.0, 1.0], [1.0, 0.3, 0.5, 1.0]])
    np.testing.assert_allclose(step.convert(actions), [[0.5, 0.0, -1.0, 0.0], [0.5, 0.0, 1.0, 0.0]], atol=1e-6)
    # Recorded with LeRobot: what the arm did not do is 0, what the gripper did not do stays as it was.
    same = {"action": {side: np.array([0.25, 1.0]) for side in ("min", "max", "q01", "q99")}}
    assert choose_statistics("dataset", {}, same)["unused"] == [True, False]


def test_prompt(published):
    tokenizer = PromptTokenizer(published, bos_token_id=1)
    ids = tokenizer("Put the KETCHUP bottle on the cloth")
    text = "In: What action should the robot take to put the ketchup bottle on the cloth?\nOut:"
    plain = tokenizer._tokenizer.encode(text).ids
    assert ids == (*plain, tokenizer.space_token_id)
    assert ids.count(1) == 1
    assert tokenizer._tokenizer.decode(list(ids)).strip() == text
    # A tokenizer that adds no beginning of its own gets one.
    tokenizer._tokenizer.post_processor = None
    tokenizer._ids.cache_clear()
    assert tokenizer("Put the KETCHUP bottle on the cloth") == ids


@pytest.mark.parametrize(("height", "width"), [(128, 128), (480, 640)])
def test_images_are_what_pil_makes_of_them(height, width):
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    image = Image.fromarray(coarse).resize((width, height), Image.Resampling.BILINEAR)
    architecture = Architecture(("", ""), (None, None), 224, tuple(MEANS), tuple(STDS), {}, 256, 64)
    tensor = torch.from_numpy(np.array(image)).permute(2, 0, 1)[None]
    pixels = prepare_images(tensor, architecture, crop=False)
    levels = np.array(image.resize((224, 224), Image.Resampling.BICUBIC)).astype(np.float64) / 255
    for half, mean, std in zip(pixels[0].chunk(2), MEANS, STDS, strict=True):
        back = half.permute(1, 2, 0).double().numpy() * np.array(std) + np.array(mean)
        # PIL computes with integers; torch's own uint8 kernel is no closer to it.
        assert np.abs(back - levels).max() < 2.01 / 255
        assert np.abs(back - levels).mean() < 0.05 / 255
    from_floats = prepare_images(tensor.float() / 255, architecture, crop=False)
    assert torch.equal(from_floats, pixels)


def test_centre_crop_by_hand():
    """Of a ramp of 20 levels a pixel, five wide: from 40 - 40 sqrt(0.9) = 2.053 to 77.947, in steps of 37.947."""
    ramp = (torch.arange(5, dtype=torch.uint8) * 20).expand(1, 3, 5, 5)
    # Times 255.5 / 255: 2.057, 40.078, 78.100; at the middle 40.078.
    assert centre_crop(ramp, 3)[0, 0, 0].tolist() == [2.0, 40.0, 78.0]


LOGITS = torch.tensor([9.0, 9.0, 9.0, 0.0, math.log(2), math.log(5), 9.0])
"""Of seven tokens, of which 3, 4, 5 are actions with probabilities 1/8, 2/8, 5/8; at temperature 1/2 they are
1/30, 4/30, 25/30."""


def test_distribution_over_the_action_tokens_only():
    hot, cold = (TokenDistribution(LOGITS.repeat(2, 1), slice(3, 6), t) for t in (1.0, 0.5))
    tokens = torch.tensor([4, 5])
    assert hot.log_prob(tokens).item() == pytest.approx(math.log(2 / 8 * 5 / 8), rel=1e-5)
    assert cold.log_prob(tokens).item() == pytest.approx(math.log(4 / 30 * 25 / 30), rel=1e-5)
    entropy = math.log(8) / 8 + math.log(4) * 2 / 8 + math.log(8 / 5) * 5 / 8
    assert hot.entropy().item() == pytest.approx(entropy, rel=1e-5)


def test_quantiles_of_the_distribution():
    uniform = torch.tensor([0.0, 0.124, 0.126, 0.374, 0.376, 0.9999999])
    distribution = TokenDistribution(LOGITS.repeat(6, 1), slice(3, 6), 1.0)
    assert distribution.quantile(uniform).tolist() == [3, 3, 4, 4, 5, 5]
    greedy = TokenDistribution(LOGITS.repeat(6, 1), slice(3, 6), 0.0)
    assert greedy.quantile(uniform).tolist() == [5] * 6
    assert greedy.log_prob(torch.full((6, 1), 5)).tolist() == [0.0] * 6
