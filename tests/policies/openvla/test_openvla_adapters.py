"""LoRA adapters as PEFT writes and reads them for the published model class."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot_policy_openvla import OpenVLAPolicy
from lerobot_policy_openvla.adapters import ADAPTER_CONFIG, ADAPTER_WEIGHTS
from openvla_samples import log_probs_and_values, make_batch, make_policy, reference_of
from peft import LoraConfig, PeftModel, get_peft_model
from published_checkpoint import BINS, VOCABULARY, Parts, make_parts
from published_model import PublishedModel
from safetensors.torch import load_file, save_file
from torch import nn

ALL_LINEAR = ["qkv", "proj", "fc1", "fc2", "fc3", "q", "kv", "q_proj", "k_proj", "v_proj", "o_proj", "gate_proj",
              "up_proj", "down_proj", "lm_head"]  # fmt: skip
"""What PEFT 0.11.1, which OpenVLA pins, makes of `all-linear` on that class: the last part of the name of each
linear layer. RL4VLA lists the same ones."""
PEFT_0_11_1 = {
    "alpha_pattern", "auto_mapping", "base_model_name_or_path", "bias", "fan_in_fan_out", "inference_mode",
    "init_lora_weights", "layer_replication", "layers_pattern", "layers_to_transform", "loftq_config",
    "lora_alpha", "lora_dropout", "megatron_config", "megatron_core", "modules_to_save", "peft_type", "r",
    "rank_pattern", "revision", "target_modules", "task_type", "use_dora", "use_rslora",
}  # fmt: skip
"""The fields of its LoraConfig. It passes all that it reads to the dataclass, so any other one is an error."""


@pytest.fixture(scope="module")
def adapted_parts() -> Parts:
    """The published modules, with the adapter of `published_adapter` inside."""
    return make_parts()


@pytest.fixture(scope="module")
def published_adapter(adapted_parts, tmp_path_factory) -> Path:
    """A LoRA adapter made and saved by PEFT on the published model class."""
    torch.manual_seed(3)
    config = LoraConfig(r=4, lora_alpha=4, target_modules=ALL_LINEAR, init_lora_weights="gaussian")
    model = get_peft_model(PublishedModel(adapted_parts), config)
    for name, parameter in model.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(parameter, std=0.05)
    folder = tmp_path_factory.mktemp("openvla") / "adapter"
    model.save_pretrained(folder)
    return folder


def test_published_adapters_do_here_what_they_do_in_peft(published, published_adapter, adapted_parts):
    """Also where the output layer is adapted: PEFT then saves its own weights, too."""
    assert any("lm_head.base_layer.weight" in name for name in load_file(published_adapter / ADAPTER_WEIGHTS))
    policy = make_policy(published, stir=False, adapter=str(published_adapter))
    batch = make_batch(2, seed=2)
    tokens = torch.arange(400, 414).reshape(2, 7)
    logits = reference_of(policy, adapted_parts, batch, tokens)[..., VOCABULARY - BINS : VOCABULARY]
    log_probs = torch.log_softmax(logits, dim=-1).gather(-1, (tokens - (VOCABULARY - BINS))[..., None])
    torch.testing.assert_close(log_probs_and_values(policy)[0], log_probs.sum((1, 2)), atol=1e-3, rtol=1e-5)


def test_an_adapter_made_on_other_weights_is_refused(published, published_adapter, tmp_path):
    folder = shutil.copytree(published_adapter, tmp_path / "other")
    state = load_file(folder / ADAPTER_WEIGHTS)
    (name,) = (name for name in state if "base_layer" in name)
    # In a less precise format they are the same weights still.
    save_file(state | {name: state[name].bfloat16()}, folder / ADAPTER_WEIGHTS)
    make_policy(published, adapter=str(folder))
    state[name][3, 5] += 0.1
    save_file(state, folder / ADAPTER_WEIGHTS)
    with pytest.raises(ValueError, match=r"made on other weights.*lm_head\.base_layer\.weight"):
        make_policy(published, adapter=str(folder))


def test_published_adapters(published, published_adapter, tmp_path):
    """Merged or apart they are the same; apart, they are what is trained and saved."""
    base = log_probs_and_values(make_policy(published, stir=False))
    apart = make_policy(published, stir=False, adapter=str(published_adapter))
    merged = make_policy(published, stir=False, adapter=str(published_adapter), merge_adapter=True)
    assert (log_probs_and_values(apart)[0] - base[0]).abs().min() > 1e-2
    torch.testing.assert_close(log_probs_and_values(merged), log_probs_and_values(apart), atol=1e-3, rtol=1e-4)
    assert apart.config.lora_rank == 4
    assert all(p.requires_grad == (".lora_" in n) for n, p in apart.network.named_parameters())
    assert all(p.requires_grad for p in merged.network.parameters())
    # The towers' last blocks, which nothing looks at, are not there to be adapted; the patch embedding is.
    assert "vision_backbone.featurizer.patch_embed.proj" in apart.config.lora_targets
    assert not any("blocks.7" in name for name in apart.config.lora_targets if ".featurizer" in name)
    apart.save_pretrained(tmp_path / "saved")
    again = OpenVLAPolicy.from_pretrained(tmp_path / "saved")
    assert torch.equal(log_probs_and_values(again), log_probs_and_values(apart))


def test_a_merged_adapter_is_in_the_saved_weights_and_not_merged_again(published, published_adapter, tmp_path):
    policy = make_policy(published, adapter=str(published_adapter), merge_adapter=True)
    policy.save_pretrained(tmp_path)
    again = OpenVLAPolicy.from_pretrained(tmp_path)
    assert torch.equal(log_probs_and_values(again), log_probs_and_values(policy))
    # It needs nothing else.
    config = PreTrainedConfig.from_pretrained(tmp_path)
    assert (config.checkpoint, config.adapter, config.merge_adapter) == (None, None, False)
    # As `--policy.path` hands the config over, and once more.
    again = OpenVLAPolicy.from_pretrained(tmp_path, config=config)
    again.save_pretrained(tmp_path / "again")
    once_more = OpenVLAPolicy.from_pretrained(tmp_path / "again")
    assert torch.equal(log_probs_and_values(once_more), log_probs_and_values(policy))


def test_adapters_are_written_for_peft(published, parts, tmp_path):
    """What is written goes onto the published model, by PEFT alone, and does there what it did here."""
    policy = make_policy(published, lora_rank=4, lora_modules=["language"])
    policy.save_adapter(tmp_path / "adapter")
    reloaded = make_policy(published, stir=False, adapter=str(tmp_path / "adapter"))
    assert torch.equal(log_probs_and_values(reloaded)[0], log_probs_and_values(policy)[0])
    assert json.loads((tmp_path / "adapter" / ADAPTER_CONFIG).read_text()).keys() <= PEFT_0_11_1
    model = PeftModel.from_pretrained(PublishedModel(make_parts()), str(tmp_path / "adapter"))
    tokens = torch.arange(1, 9)[None]
    with torch.no_grad():
        expected = policy.network.language_model(input_ids=tokens).logits
        torch.testing.assert_close(model.base_model.model.language_model(input_ids=tokens).logits, expected)
        plain = parts.language_model(input_ids=tokens).logits
    assert (plain - expected).abs().max() > 1e-2
