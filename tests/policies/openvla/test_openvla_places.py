"""What a policy is built on: a folder as it was called elsewhere, and the Hub's commit that was first built on."""

import shutil

import huggingface_hub
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot_policy_openvla import OpenVLAPolicy
from openvla_samples import log_probs_and_values, make_policy
from safetensors.torch import load_file, save_file

from cronos_lerobot.evaluation.policy_source import fingerprint

NAME, FIRST, SECOND = "me/openvla", "1" * 40, "2" * 40
LORA = {"lora_rank": 2, "lora_modules": ["projector"]}


def fingerprint_of(folder):
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return fingerprint(config)


@pytest.mark.parametrize("kind", ["lora", "peft"])
def test_a_folder_is_found_from_other_ones(kind, published, tmp_path, monkeypatch):
    project = tmp_path / "project"
    shutil.copytree(published, project / "outputs/base")
    monkeypatch.chdir(project)
    policy, saved = make_policy("outputs/base", **LORA), project / "outputs/run/pretrained_model"
    policy.save_pretrained(saved)
    if kind == "peft":
        # What `lerobot-train --peft.*` leaves has no weights but the adapter's.
        policy.save_adapter(saved)
        (saved / "model.safetensors").unlink()
        policy = OpenVLAPolicy.from_pretrained(saved)
    expected, known = log_probs_and_values(policy), fingerprint_of(saved)
    monkeypatch.chdir(tmp_path)
    config = PreTrainedConfig.from_pretrained(saved)
    assert torch.equal(log_probs_and_values(OpenVLAPolicy.from_pretrained(saved, config=config)), expected)
    if kind == "lora":
        assert config.checkpoint == "outputs/base", "the caller's config stays as it was"
        assert fingerprint_of(saved) == known
    shutil.rmtree(project / "outputs/base")
    with pytest.raises(FileNotFoundError, match=r"^outputs/base is no folder, .* the Hub did not give it"):
        OpenVLAPolicy.from_pretrained(saved)


@pytest.fixture
def cache(published, tmp_path, monkeypatch):
    """The Hub's cache with two commits of a repository, and no Hub; sets which one `main` is."""
    folder = tmp_path / "hub/models--me--openvla"
    for commit in (FIRST, SECOND):
        shutil.copytree(published, folder / "snapshots" / commit)
    weights = folder / "snapshots" / SECOND / "model.safetensors"
    if not weights.is_file():
        weights = next(weights.parent.glob("*.safetensors"))
    save_file({name: tensor * 1.5 for name, tensor in load_file(weights).items()}, weights, {"format": "pt"})
    (folder / "refs").mkdir()
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    return lambda commit: (folder / "refs/main").write_text(commit)


def test_a_repository_is_held_at_the_commit_that_was_first_built_on(cache, tmp_path):
    cache(FIRST)
    policy = make_policy(NAME, **LORA)
    assert policy.config.checkpoint_revision == FIRST
    policy.save_pretrained(tmp_path / "pinned")
    expected, known = log_probs_and_values(policy), fingerprint_of(tmp_path / "pinned")
    cache(SECOND)
    again = OpenVLAPolicy.from_pretrained(tmp_path / "pinned")
    assert torch.equal(log_probs_and_values(again), expected)
    assert fingerprint_of(tmp_path / "pinned") == known
