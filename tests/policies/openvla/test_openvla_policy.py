"""The policy against timm and transformers called by hand, and its two ways of computing against each other."""

import pytest
import torch
from lerobot_policy_openvla.images import prepare_images
from lerobot_policy_openvla.modeling_openvla import FEATURES
from openvla_samples import CAMERA, make_batch, make_policy, reference_of, take
from published_checkpoint import BINS, VOCABULARY, reference_logits


@pytest.fixture(scope="module")
def base(published):
    return make_policy(published)


@pytest.fixture(scope="module")
def lora(published):
    return make_policy(published, lora_rank=4)


def test_log_probabilities_are_those_of_the_published_modules(base, parts):
    batch = make_batch(3)
    tokens = torch.randint(VOCABULARY - BINS, VOCABULARY, (3, 7), generator=torch.Generator().manual_seed(1))
    logits = reference_of(base, parts, batch, tokens)[..., VOCABULARY - BINS : VOCABULARY]
    log_probs = torch.log_softmax(logits / 0.7, dim=-1)
    expected = log_probs.gather(-1, (tokens - (VOCABULARY - BINS))[..., None]).sum((1, 2))
    entropy = -(log_probs.exp() * log_probs).sum(-1).mean(-1)
    with torch.no_grad():
        result = base.evaluate_actions(batch, tokens, temperature=0.7)
    torch.testing.assert_close(result["log_prob"], expected, atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(result["entropy"], entropy, atol=1e-4, rtol=1e-5)


def test_greedy_tokens_with_the_cache_are_those_without(base, parts):
    batch = make_batch(3, seed=1)
    tokens = base.sample_actions(batch, temperature=0.0)["trace"]
    pixels = prepare_images(batch[CAMERA], base.architecture, crop=False)
    for row, (image, text) in enumerate(zip(pixels, batch["task"], strict=True)):
        drawn: list[int] = []
        for _ in range(7):
            logits = reference_logits(parts, image, list(base.prompt_tokenizer(text)), drawn)[-1]
            drawn.append(VOCABULARY - BINS + int(logits[VOCABULARY - BINS : VOCABULARY].argmax()))
        assert tokens[row].tolist() == drawn
    assert len({tuple(row) for row in tokens.tolist()}) > 1


@pytest.mark.parametrize("kind", ["base", "lora"])
def test_ratio_is_one_before_the_first_update(kind, request):
    policy = request.getfixturevalue(kind)
    batch = make_batch(5)
    sample = policy.sample_actions(batch, temperature=0.8, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        again = policy.evaluate_actions(batch, sample["trace"], temperature=0.8)
        values = policy.predict_values(batch)
    ratio = (again["log_prob"] - sample["log_prob"]).exp()
    torch.testing.assert_close(ratio, torch.ones(5), atol=1e-4, rtol=0)
    torch.testing.assert_close(again["value"], sample["value"], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(values, sample["value"], atol=1e-4, rtol=1e-4)
    assert sample["value"].std() > 1e-3
    assert sample["trace"].min() >= VOCABULARY - BINS
    assert sample["trace"].max() < VOCABULARY
    assert sample["actions"].abs().max() <= 1


def test_a_sample_does_not_depend_on_its_batch(published):
    """Neither on the others in it, their prompts' lengths, nor on how many act at a time."""
    policy = make_policy(published, inference_batch_size=2)
    batch = make_batch(5)
    uniform = torch.rand(5, 7, generator=torch.Generator().manual_seed(0))
    together = policy.sample_actions(batch, uniform=uniform)
    for row in range(5):
        alone = policy.sample_actions(take(batch, [row]), uniform=uniform[row : row + 1])
        assert torch.equal(alone["trace"][0], together["trace"][row])
        torch.testing.assert_close(alone["log_prob"][0], together["log_prob"][row], atol=1e-4, rtol=0)
    first, second = (policy.sample_actions(batch, generator=torch.Generator().manual_seed(3)) for _ in range(2))
    assert torch.equal(first["trace"], second["trace"])
    assert not torch.equal(first["trace"], together["trace"])


def test_what_is_trained(lora, published):
    groups = {group["name"]: group["params"] for group in lora.rl_parameter_groups()}
    trained = {id(p) for params in groups.values() for p in params}
    names = {name for name, p in lora.named_parameters() if id(p) in trained}
    assert names == {name for name, p in lora.named_parameters() if p.requires_grad}
    assert all(".lora_" in name or name.startswith("value_head.") for name in names)
    for part in ("vision_backbone.featurizer.blocks.6.mlp.fc1", "projector.fc3", "language_model.lm_head"):
        assert f"network.{part}.lora_A.default.weight" in names
    # Rank 4 on a layer from 64 to 96: 4 (64 + 96) numbers.
    gate = "network.language_model.model.layers.1.mlp.gate_proj.lora_"
    assert sum(p.numel() for n, p in lora.named_parameters() if n.startswith(gate)) == 640
    some = make_policy(published, lora_rank=4, lora_modules=["projector"])
    assert {n.split(".")[1] for n, p in some.named_parameters() if ".lora_" in n} == {"projector"}
    # Every trained parameter gets a gradient: nothing that is never used is adapted.
    batch = make_batch(2)
    result = lora.evaluate_actions(batch, lora.sample_actions(batch)["trace"])
    (result["log_prob"].sum() + result["value"].sum()).backward()
    assert [n for n, p in lora.named_parameters() if p.requires_grad and p.grad is None] == []
    lora.zero_grad(set_to_none=True)


def test_value_gradient_can_be_kept_from_the_network(published):
    for detach in (False, True):
        policy = make_policy(published, lora_rank=4, value_detach=detach)
        policy.predict_values(make_batch(2)).sum().backward()
        reached = any(p.grad is not None for p in policy.network.parameters())
        assert reached is not detach


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_kept_features_stand_for_the_image(published, dtype):
    """With the towers frozen; through NumPy and back, as the trainer keeps them."""
    policy = make_policy(published, lora_rank=4, lora_modules=["projector", "language"], dtype=dtype)
    batch = make_batch(3)
    encode = policy.encode_observation
    assert encode is not None
    encoded = encode(batch)
    assert CAMERA not in encoded
    assert encoded[FEATURES].shape == (3, 16, 64 + 96)
    kept = torch.from_numpy(encoded[FEATURES].numpy().copy())
    uniform = torch.rand(3, 7)
    from_image = policy.sample_actions(batch, uniform=uniform)
    from_kept = policy.sample_actions({"task": batch["task"], FEATURES: kept}, uniform=uniform)
    assert torch.equal(from_image["trace"], from_kept["trace"])
    assert torch.equal(from_image["log_prob"], from_kept["log_prob"])
    assert make_policy(published, lora_rank=4).encode_observation is None


def test_bfloat16_is_close_and_its_adapters_are_float32(published):
    batch = make_batch(4)
    policies = [make_policy(published, lora_rank=4, dtype=dtype) for dtype in ("float32", "bfloat16")]
    tokens = policies[0].sample_actions(batch)["trace"]
    with torch.no_grad():
        exact, rough = (policy.evaluate_actions(batch, tokens)["log_prob"] for policy in policies)
    assert (exact - rough).abs().max() < 0.1 * exact.abs().max()
    kinds = {p.dtype for n, p in policies[1].named_parameters() if ".lora_" in n or "value_head" in n}
    assert kinds == {torch.float32}
    assert policies[1].network.projector.fc1.base_layer.weight.dtype == torch.bfloat16
    assert rough.dtype == torch.float32


def test_loss_is_the_mean_over_the_tokens_of_the_whole_vocabulary(base, parts):
    batch = make_batch(2) | {"action": torch.tensor([[-1.0] * 7, [0.5] * 7])}
    # -1 is the last token; 0.5 is in bin 191 (191.25 bins of 2/255 above -1), the 192nd from the end.
    tokens = torch.tensor([[VOCABULARY - 1] * 7, [VOCABULARY - 192] * 7])
    log_probs = torch.log_softmax(reference_of(base, parts, batch, tokens), dim=-1)
    expected = -log_probs.gather(-1, tokens[..., None])[..., 0].mean(1)
    with torch.no_grad():
        losses, _ = base.forward(batch, reduction="none")
        padded, _ = base.forward(batch | {"action_is_pad": torch.tensor([[False], [True]])})
    torch.testing.assert_close(losses, expected, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(padded, expected[0], atol=1e-4, rtol=1e-5)
