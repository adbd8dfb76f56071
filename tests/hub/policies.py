"""Checkpoints as far as a card reads them, and the cards that they get."""

import json
import re
import shlex

import draccus
import numpy as np
from lerobot_env_cronos.config import CronosEnvConfig
from safetensors.numpy import save_file
from synthetic_runs import edit_starts, write_training_run

from cronos_lerobot.hub.config import PolicyConfig
from cronos_lerobot.scripts.publish import publish_policy
from cronos_lerobot.training.config import CronosTrainConfig

STATE = {"obs_type": "environment_state_agent_pos"}
ACTION = {"action": {"type": "ACTION", "shape": [7]}}
STEPS = 160 * 8 * 8
"""Of the runs of `write_training_run`."""


def features_of(env):
    """What LeRobot writes into the config.json of a policy that takes all that `env` shows."""
    features = {env.features_map[name]: feature for name, feature in env.features.items() if name != "action"}
    return {
        name: {"type": f.type.value, "shape": [f.shape[2], *f.shape[:2]] if len(f.shape) == 3 else list(f.shape)}
        for name, f in features.items()
    }


def write_model(model, features=None, trained=None, files=None, **config):
    """A policy's folder; `files` lie beside it."""
    model.mkdir(parents=True)
    config = {"type": "act", "input_features": features or {}, "output_features": ACTION} | config
    (model / "config.json").write_text(json.dumps(config))
    if trained is not None:
        (model / "train_config.json").write_text(json.dumps(trained))
    tensors = {"weight": np.zeros((2, 2), np.float32)}
    for name, content in ({"model.safetensors": tensors} | (files or {})).items():
        save_file(content, model / name) if name.endswith("safetensors") else (model / name).write_text(content)
    return model


def train_config(env, algorithm=None, **changes):
    """The train_config.json of `cronos-train`."""
    config = CronosTrainConfig(env=env, **({"algorithm": algorithm} if algorithm else {}))
    return json.loads(json.dumps(draccus.encode(config))) | changes


def write_run(root, env=None, algorithm=None, step=STEPS, **model):
    """A run folder of `cronos-train` with one checkpoint."""
    env = env or CronosEnvConfig(**STATE)
    trained = train_config(env, algorithm)
    run = write_training_run(root / "run")
    edit_starts(run, lambda starts: starts[0].update(config=trained))
    folder = run / f"checkpoints/{step:07d}/pretrained_model"
    model = {"features": features_of(env), "trained": trained} | model
    write_model(folder, **model)
    (run / "checkpoints/last").symlink_to(folder.parent.name)
    return run


def dry_run(path, out, **flags):
    """The card of a policy."""
    publish_policy(PolicyConfig(repo_id="me/p", path=path, dry_run=True, output_dir=out, **flags))
    return (out / "README.md").read_text()


def commands(card):
    """The words of each command for evaluating, by its name."""
    blocks = re.findall(r"```bash\n((?:cronos|lerobot)-eval .*?)```", card, re.DOTALL)
    words = [shlex.split(block.replace("\\\n", " ")) for block in blocks]
    return {command[0]: command[1:] for command in words}


def rows(card):
    """Cells of all tables."""
    return [[cell.strip("` ") for cell in line.split(" | ")] for line in re.findall(r"^\| (.*) \|$", card, re.M)]
