"""Published checkpoints, adapters, and what is saved of a policy, in all formats."""

import json
import shutil
from pathlib import Path

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot_policy_openvla import OpenVLAPolicy, make_openvla_pre_post_processors
from openvla_samples import log_probs_and_values, make_batch, make_config, make_policy
from published_checkpoint import MEANS, write_checkpoint
from safetensors.torch import load_file, save_file
from torch import nn


def test_published_config_is_read(published):
    config = make_config(published)
    config.resolve()
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


MY_ROBOT = {
    "q01": [-0.5] * 6 + [0.0], "q99": [0.1] * 6 + [1.0], "mask": [True] * 6 + [False],
    "mean": [0.0] * 7, "std": [1.0] * 7, "min": [-1.0] * 7, "max": [1.0] * 7,
}  # fmt: skip


def write_statistics(folder: Path) -> None:
    """As the published fine-tuning script leaves them beside what it trained."""
    contents = {"my_robot": {"action": MY_ROBOT, "num_transitions": 10, "num_trajectories": 1}}
    (folder / "dataset_statistics.json").write_text(json.dumps(contents))


@pytest.mark.parametrize("beside", ["checkpoint", "adapter"])
def test_statistics_of_a_fine_tuning_run_replace_the_others(beside, published, tmp_path):
    folder = shutil.copytree(published, tmp_path / "merged")
    adapter = None
    if beside == "adapter":
        make_policy(published, lora_rank=2).save_adapter(tmp_path / "adapter")
        adapter = str(tmp_path / "adapter")
    write_statistics(tmp_path / "adapter" if adapter else folder)
    for key in ("my_robot", None):
        config = make_config(folder, adapter=adapter, unnorm_key=key)
        _, postprocessor = make_openvla_pre_post_processors(config)
        assert config.unnorm_key == "my_robot"
        # 0.5 (0.5 + 1) (0.1 + 0.5) - 0.5
        assert postprocessor(torch.full((1, 7), 0.5))[0].tolist() == pytest.approx([-0.05] * 6 + [0.5])
    with pytest.raises(ValueError, match=r"'bridge_orig' is not one of \['my_robot'\]"):
        make_config(folder, adapter=adapter).resolve()


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


def test_settings_that_a_saved_policy_cannot_change(published, tmp_path):
    policy = make_policy(published, lora_rank=4)
    policy.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=["--unnorm_key=other"])
    with pytest.raises(ValueError, match=r"'other'.*'bridge_orig'"):
        OpenVLAPolicy.from_pretrained(tmp_path, config=config)
    with pytest.raises(ValueError, match="--peft"):
        policy.wrap_with_peft(peft_cli_overrides={"r": 4})
