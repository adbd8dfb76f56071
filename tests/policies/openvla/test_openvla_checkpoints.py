"""Published checkpoints, adapters, and what is saved of a policy, in all formats."""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot_policy_openvla import OpenVLAConfig, OpenVLAPolicy, make_openvla_pre_post_processors
from lerobot_policy_openvla.adapters import ADAPTER_WEIGHTS
from openvla_samples import CAMERA, INPUTS, OUTPUTS, make_batch, make_config, make_policy
from peft import LoraConfig, get_peft_model
from published_checkpoint import MEANS, write_checkpoint
from safetensors.torch import load_file, save_file
from torch import nn


def log_probs_and_values(policy, seed=2):
    batch = make_batch(2, seed)
    tokens = torch.arange(400, 414).reshape(2, 7)
    with torch.no_grad():
        result = policy.eval().evaluate_actions(batch, tokens)
    return torch.stack([result["log_prob"], result["value"]])


def test_published_config_is_read(published):
    config = make_config(published)
    config.resolve()
    assert config.unnorm_key == "bridge_orig"
    assert config.architecture["image_means"] == tuple(map(tuple, MEANS))
    policy = make_policy(published)
    assert policy.action_tokenizer.token_range == slice(384, 640)
    assert policy.network.language_model.config.rms_norm_eps == 1e-6
    processors = make_openvla_pre_post_processors(config)
    batch = processors[0](make_batch(2) | {"action": torch.tensor([[0.0, 0, 0, 0, 0, 0, 1.0]] * 2)})
    # (0 - q01) / (q99 - q01) of dx is 0.503661.
    assert batch["action"][0, 0].item() == pytest.approx(2 * 0.503661 - 1, abs=1e-5)
    action = processors[1](policy.select_action(batch))
    assert action.shape == (2, 7)
    assert (action[:, :6].abs() < 0.21).all()


def test_one_file_or_many_shards(parts, tmp_path, published):
    folder = write_checkpoint(tmp_path / "one", parts)
    tensors = parts.published_tensors()
    for path in folder.glob("model*"):
        path.unlink()
    save_file({name: tensor.clone() for name, tensor in tensors.items()}, folder / "model.safetensors")
    expected = log_probs_and_values(make_policy(published, stir=False))
    assert torch.equal(log_probs_and_values(make_policy(folder, stir=False)), expected)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model_type": "llama"}, "model_type='llama'"),
        ({"use_fused_vision_backbone": False}, "use_fused_vision_backbone"),
        ({"image_resize_strategy": "letterbox"}, "letterbox"),
        ({"timm_model_ids": ["test_vit2"]}, "Two vision towers"),
        ({"timm_model_ids": ["test_vit3", "test_vit3"]}, r"projector\.fc1.*768"),
    ],
)
def test_other_networks_are_refused(changes, message, published, tmp_path):
    folder = shutil.copytree(published, tmp_path / "other")
    config = json.loads((folder / "config.json").read_text()) | changes
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=message):
        make_policy(folder)


def test_missing_and_unknown_tensors_are_refused(published, tmp_path):
    folder = shutil.copytree(published, tmp_path / "broken")
    shard = folder / "model-00001-of-00002.safetensors"
    tensors = load_file(shard)
    left_out = next(name for name in tensors if name.startswith("language_model.model.layers"))
    save_file({name: tensor for name, tensor in tensors.items() if name != left_out}, shard)
    with pytest.raises(ValueError, match=f"lacks 1 tensors.*{left_out}"):
        make_policy(folder)
    save_file(tensors | {"language_model.extra": torch.zeros(2)}, shard)
    with pytest.raises(ValueError, match=r"language_model\.extra"):
        make_policy(folder)


def test_bad_settings_are_refused(published):
    with pytest.raises(ValueError, match="checkpoint=openvla/openvla-7b"):
        OpenVLAPolicy(OpenVLAConfig(input_features=INPUTS, output_features=OUTPUTS, device="cpu"))
    with pytest.raises(ValueError, match=r"'audio'.*projector"):
        make_config(published, lora_modules=["audio"])
    with pytest.raises(ValueError, match="'fp8'"):
        make_config(published, dtype="fp8")
    with pytest.raises(ValueError, match="merge_adapter"):
        make_config(published, adapter="somewhere", lora_rank=4)
    with pytest.raises(ValueError, match="image_key"):
        make_policy(published, image_key="observation.images.wrist")


def test_quantisation_needs_its_package(published):
    if find_spec("bitsandbytes"):
        policy = make_policy(published, lora_rank=4, quantization="nf4")
        assert log_probs_and_values(policy).isfinite().all()
    else:
        with pytest.raises(ImportError, match=r"lerobot_policy_openvla\[quantized\]"):
            make_policy(published, lora_rank=4, quantization="nf4")


def test_a_policy_with_adapters_saves_them_alone(published, tmp_path):
    policy = make_policy(published, lora_rank=4, lora_modules=["projector", "language"])
    policy.save_pretrained(tmp_path)
    names = set(load_file(tmp_path / "model.safetensors"))
    assert names == {name for name, p in policy.named_parameters() if p.requires_grad}
    again = OpenVLAPolicy.from_pretrained(tmp_path)
    assert torch.equal(log_probs_and_values(again), log_probs_and_values(policy))
    for name, parameter in policy.named_parameters():
        assert torch.equal(again.get_parameter(name), parameter), name
    # Moved weights: the folder is named on the command line.
    moved = shutil.copytree(published, tmp_path / "moved")
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=[f"--checkpoint={moved}"])
    elsewhere = OpenVLAPolicy.from_pretrained(tmp_path, config=config)
    assert torch.equal(log_probs_and_values(elsewhere), log_probs_and_values(policy))


def test_a_whole_policy_needs_no_checkpoint(published, tmp_path):
    shutil.copytree(published, tmp_path / "published")
    policy = make_policy(tmp_path / "published", dtype="bfloat16")
    policy.save_pretrained(tmp_path / "whole")
    expected = log_probs_and_values(policy)
    shutil.rmtree(tmp_path / "published")
    again = OpenVLAPolicy.from_pretrained(tmp_path / "whole")
    assert torch.equal(log_probs_and_values(again), expected)
    # LoRA on top of it, saved and loaded again.
    config = PreTrainedConfig.from_pretrained(tmp_path / "whole", cli_overrides=["--lora_rank=4"])
    adapted = OpenVLAPolicy.from_pretrained(tmp_path / "whole", config=config)
    assert torch.equal(log_probs_and_values(adapted), expected)
    nn.init.normal_(adapted.network.projector.fc1.lora_B["default"].weight)
    adapted.save_pretrained(tmp_path / "adapted")
    loaded = OpenVLAPolicy.from_pretrained(tmp_path / "adapted")
    assert torch.equal(log_probs_and_values(loaded), log_probs_and_values(adapted))
    assert not torch.equal(log_probs_and_values(loaded), expected)


class PublishedModel(nn.Module):
    """The published model class as PEFT sees it: the same modules under the same names."""

    def __init__(self, parts):
        super().__init__()
        self.vision_backbone = nn.Module()
        self.vision_backbone.featurizer = parts.featurizer
        self.vision_backbone.fused_featurizer = parts.fused_featurizer
        self.projector = parts.projector
        self.language_model = parts.language_model


@pytest.fixture(scope="module")
def published_adapter(published, tmp_path_factory) -> Path:
    """A LoRA adapter made by PEFT on the published model, with the layer names that OpenVLA's users give."""
    from published_checkpoint import make_parts

    torch.manual_seed(3)
    targets = ["proj", "qkv", "fc1", "fc2", "q", "kv", "fc3", "q_proj", "k_proj", "v_proj", "o_proj",
               "gate_proj", "up_proj", "down_proj", "lm_head"]  # fmt: skip
    config = LoraConfig(r=4, lora_alpha=4, target_modules=targets, init_lora_weights="gaussian")
    model = get_peft_model(PublishedModel(make_parts()), config)
    for name, parameter in model.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(parameter, std=0.05)
    folder = tmp_path_factory.mktemp("openvla") / "adapter"
    model.save_pretrained(folder)
    return folder


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


def test_fresh_adapters_on_top_of_a_merged_one(published, published_adapter, tmp_path):
    policy = make_policy(published, adapter=str(published_adapter), merge_adapter=True, lora_rank=2)
    policy.save_pretrained(tmp_path)
    again = OpenVLAPolicy.from_pretrained(tmp_path)
    assert torch.equal(log_probs_and_values(again), log_probs_and_values(policy))


def test_adapters_are_written_for_peft(published, parts, tmp_path):
    """What is written goes onto the published model, by PEFT alone, and does there what it did here."""
    policy = make_policy(published, lora_rank=4, lora_modules=["language"])
    policy.save_adapter(tmp_path / "adapter")
    reloaded = make_policy(published, stir=False, adapter=str(tmp_path / "adapter"))
    assert torch.equal(log_probs_and_values(reloaded)[0], log_probs_and_values(policy)[0])
    from peft import PeftModel
    from published_checkpoint import make_parts

    model = PeftModel.from_pretrained(PublishedModel(make_parts()), str(tmp_path / "adapter"))
    tokens = torch.arange(1, 9)[None]
    with torch.no_grad():
        expected = policy.network.language_model(input_ids=tokens).logits
        torch.testing.assert_close(model.base_model.model.language_model(input_ids=tokens).logits, expected)
        plain = parts.language_model(input_ids=tokens).logits
    assert (plain - expected).abs().max() > 1e-2
    with pytest.raises(ValueError, match="lora_rank"):
        make_policy(published).save_adapter(tmp_path / "none")


def test_adapters_of_another_network_are_refused(published, published_adapter, tmp_path):
    folder = shutil.copytree(published_adapter, tmp_path / "other")
    state = load_file(folder / ADAPTER_WEIGHTS)
    renamed = {key.replace("language_model", "llm"): value for key, value in state.items()}
    save_file(renamed, folder / ADAPTER_WEIGHTS, metadata={"format": "pt"})
    with pytest.raises(ValueError, match="llm"):
        make_policy(published, adapter=str(folder))


def test_settings_that_a_saved_policy_cannot_change(published, tmp_path):
    policy = make_policy(published, lora_rank=4)
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--unnorm_key=other"])
    with pytest.raises(ValueError, match=r"'other'.*'bridge_orig'"):
        OpenVLAPolicy.from_pretrained(tmp_path, config=config)
    with pytest.raises(ValueError, match="--peft"):
        policy.wrap_with_peft(peft_cli_overrides={"r": 4})


def test_the_image_may_have_any_size(published):
    policy = make_policy(published)
    batch = make_batch(1)
    assert policy.select_action(batch | {CAMERA: torch.zeros(1, 3, 100, 200)}).shape == (1, 7)
