"""What a policy's card takes from its checkpoint: which end of its run, what was renamed, and its tags."""

import json
import re
import shlex

import numpy as np
import pytest
import yaml
from lerobot_env_cronos import CronosEnvConfig
from lerobot_env_cronos.scene.model import CAMERAS
from safetensors.numpy import save_file
from test_policy_cards import STATE, dry_run, features_of, write_checkpoint

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.hub import policy as hub_policy
from cronos_lerobot.hub.eval_flags import cronos_eval_flags


def test_tags_that_yaml_would_take_for_something_else(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "act", CronosEnvConfig(**STATE), PPOConfig())
    path = checkpoint / "pretrained_model/config.json"
    tags = ["stage: 2", "#sim", "no", "1.0", "@home"]
    path.write_text(json.dumps(json.loads(path.read_text()) | {"tags": tags}))
    front = yaml.safe_load(dry_run(checkpoint, tmp_path / "out").split("---")[1])
    assert front["tags"][-5:] == tags


def test_a_checkpoint_of_an_end_that_its_run_no_longer_has_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    checkpoint = write_checkpoint(tmp_path, "pocketvla", CronosEnvConfig(**STATE), PPOConfig())
    note = checkpoint / "training_state/run.json"
    note.parent.mkdir()
    note.write_text(json.dumps({"interventions": 4, "environment": None}))
    assert "after 32 interaction steps" in dry_run(checkpoint, tmp_path / "out")
    # Other resets from an earlier checkpoint on, and not as far yet.
    note.write_text(json.dumps({"interventions": 9, "environment": None}))
    with pytest.raises(ValueError, match=r"it had 9 interventions at step 32, and the run, .*, comes to 4"):
        dry_run(checkpoint, tmp_path / "other")
    metrics = tmp_path / "run/metrics.jsonl"
    metrics.write_text(metrics.read_text().replace('"interaction_steps": 32', '"interaction_steps": 16'))
    with pytest.raises(ValueError, match=r"it had 9 interventions at step 32, .*, ends at step 16"):
        dry_run(checkpoint, tmp_path / "short")


def test_what_a_clone_renamed_is_in_its_commands(tmp_path, monkeypatch):
    monkeypatch.setattr(hub_policy, "FIGURES", {})
    names = {f"observation.images.{camera}": f"observation.images.camera{i}" for i, camera in enumerate(CAMERAS)}
    model, env = tmp_path / "clone", CronosEnvConfig(camera_name=",".join(CAMERAS))
    model.mkdir()
    features = {names.get(key, key): feature for key, feature in features_of(env).items()}
    config = {
        "type": "smolvla",
        "input_features": features,
        "output_features": {"action": {"type": "ACTION", "shape": [7]}},
    }
    (model / "config.json").write_text(json.dumps(config))
    (model / "train_config.json").write_text(json.dumps({"rename_map": names}))
    save_file({"weight": np.zeros(1, np.float32)}, model / "model.safetensors")
    card = dry_run(model, tmp_path / "out", scene="kitchen_2x2")
    blocks = re.findall(r"```bash\n((?:cronos|lerobot)-eval .*?)```", card, re.DOTALL)
    (lerobot_eval,) = (shlex.split(block.replace("\\\n", " ")) for block in blocks)
    for words in (lerobot_eval, shlex.split(" ".join(cronos_eval_flags(config, {}, "kitchen_2x2", names)))):
        (renamed,) = [word for word in words if word.startswith("--rename_map=")]
        assert json.loads(renamed.partition("=")[2]) == names
        assert "--env.camera_name=front,bridge" in words
    with pytest.raises(ValueError, match=r"unknown scene 'kichen_2x2'.*kitchen_2x2"):
        dry_run(model, tmp_path / "typo", scene="kichen_2x2")
