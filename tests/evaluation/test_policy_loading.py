"""Adapters find the policy that they go onto, from wherever a command is run."""

import json
import logging
import shutil

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.configs.default import PeftConfig
from lerobot_env_cronos import CronosEnvConfig
from tiny_checkpoints import STATE, TINY_ACT, save_policy

from cronos_lerobot.agents import weights
from cronos_lerobot.evaluation.policy_loading import load_policy
from cronos_lerobot.evaluation.policy_source import fingerprint

BASE, RUN = "outputs/clone/pretrained_model", "outputs/train/run/checkpoints/000020/pretrained_model"
ENV = CronosEnvConfig(**STATE)


def config_in(folder):
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return config


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A project with a clone, and adapters that were trained in it on `outputs/clone/...`; and what they do."""
    project = tmp_path_factory.mktemp("project")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(project)
        save_policy(project / BASE, "act", STATE, **TINY_ACT)
        config = config_in(BASE)
        policy = weights.wrap(
            load_policy(config, ENV), PeftConfig(r=2, target_modules=["linear1", "linear2"], init_type="gaussian")
        )
        for name, param in policy.named_parameters():
            if "lora_B" in name:
                torch.nn.init.normal_(param)
        weights.save_policy(policy, project / RUN)
        named = json.loads((project / RUN / "adapter_config.json").read_text())["base_model_name_or_path"]
        assert named == BASE
        return project, actions(policy), fingerprint(config_in(project / RUN))


@torch.no_grad()
def actions(policy):
    config, generator = weights.unwrapped(policy).config, torch.Generator().manual_seed(0)
    batch = {name: torch.randn(2, *f.shape, generator=generator) for name, f in config.input_features.items()}
    return policy.eval().predict_action_chunk(batch)


@pytest.mark.parametrize("where", [".", "outputs", ".."])
def test_from_other_folders_it_is_the_same_policy(where, trained, monkeypatch):
    project, expected, known = trained
    monkeypatch.chdir(project / where)
    config = config_in(project / RUN)
    policy = load_policy(config, ENV)
    assert torch.equal(actions(policy), expected)
    assert weights.is_wrapped(policy)
    assert all("lora_" in name for name, param in policy.named_parameters() if param.requires_grad)
    assert (config.use_peft, config.pretrained_path) == (True, project / RUN)
    assert fingerprint(config) == known


def test_adapters_that_are_saved_elsewhere_find_it_too(trained, tmp_path, monkeypatch):
    project, expected, known = trained
    monkeypatch.chdir(tmp_path)
    weights.save_policy(load_policy(config_in(project / RUN), ENV), tmp_path / "again")
    again = config_in(tmp_path / "again")
    assert torch.equal(actions(load_policy(again, ENV)), expected)
    assert fingerprint(again) == known


def test_the_folder_that_was_trained_on_goes_before_one_of_its_name_here(trained, tmp_path, monkeypatch, caplog):
    project, expected, _ = trained
    other = shutil.copytree(project / BASE, tmp_path / BASE)
    shutil.copy(project / RUN / "adapter_model.safetensors", other / "model.safetensors")
    monkeypatch.chdir(tmp_path)
    caplog.set_level(logging.INFO)
    assert torch.equal(actions(load_policy(config_in(project / RUN), ENV)), expected)
    assert f"go onto the policy in {project / BASE}." in caplog.text
