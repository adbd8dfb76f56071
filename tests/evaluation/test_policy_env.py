"""The renderer of the pictures that a policy learned from is the one that it is evaluated with."""

import sys

import pytest
from lerobot.configs import PreTrainedConfig
from tiny_checkpoints import STATE, record_one, save_policy, write_train_config

from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.policy_env import trained_renderer

FILAMENT = {"renderer": "filament"}


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """Demonstrations that say that Filament was asked for; without pictures it is not needed here."""
    return record_one(tmp_path_factory.mktemp("demos") / "demos", **FILAMENT)


def test_the_renderer_is_the_runs_or_that_of_the_cloned_demonstrations(demos, tmp_path):
    dataset = {"repo_id": "me/demos", "root": str(demos)}
    assert trained_renderer(write_train_config(tmp_path, env={"type": "cronos"} | FILAMENT)) == FILAMENT
    assert trained_renderer(write_train_config(tmp_path, env=None, dataset=dataset)) == FILAMENT
    # What lerobot-train evaluates in is not what it learned from.
    classic = {"type": "cronos", "renderer": "classic"}
    assert trained_renderer(write_train_config(tmp_path, env=classic, dataset=dataset)) == FILAMENT
    elsewhere = dataset | {"root": str(tmp_path)}
    assert trained_renderer(write_train_config(tmp_path, env=None, dataset=elsewhere)) == {}
    # Of runs of before there was a choice, of other packages, and of nothing.
    assert trained_renderer(write_train_config(tmp_path, env={"type": "cronos"})) == {}
    assert trained_renderer(write_train_config(tmp_path, env={"type": "libero"} | FILAMENT)) == {}
    assert trained_renderer(tmp_path / "none") == {}


@pytest.mark.parametrize(
    ("observation", "flags", "renderer"),
    [
        ({}, [], "filament"),
        ({}, ["--env.renderer=classic"], "classic"),
        # It would draw the videos alone.
        (STATE, [], "classic"),
    ],
)
def test_an_evaluation_draws_as_the_training_did_unless_it_is_told(
    observation, flags, renderer, tmp_path, monkeypatch
):
    monkeypatch.setattr(sys, "argv", ["cronos-eval", *flags])
    folder = save_policy(tmp_path, "pocketvla", observation, hidden_width=16, hidden_depth=1)
    policy = PreTrainedConfig.from_pretrained(write_train_config(folder, env={"type": "cronos"} | FILAMENT))
    policy.pretrained_path = folder
    config = CronosEvalConfig(policy=policy)
    config.validate()
    assert config.env.renderer == renderer
    assert config.identity().get("renderer", "classic") == renderer
