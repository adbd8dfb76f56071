"""Untrained policies and single demonstrations on disk."""

import json
from pathlib import Path

from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig

from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos

STATE = {"obs_type": "environment_state_agent_pos"}
TOLD = STATE | {"task_observation": "one_hot"}
"""For policies that read no instruction."""
TINY_ACT = {
    "chunk_size": 6, "n_action_steps": 4, "dim_model": 16, "n_heads": 2, "dim_feedforward": 32,
    "n_encoder_layers": 1, "n_decoder_layers": 1, "use_vae": False, "pretrained_backbone_weights": None,
}  # fmt: skip


def save_policy(folder: Path, kind: str, env_options: dict, **options) -> Path:
    """An untrained policy as a checkpoint."""
    register_third_party_plugins()
    env_config = CronosEnvConfig(**env_options)
    config = make_policy_config(kind, device="cpu", push_to_hub=False, **options)
    policy = make_policy(config, env_cfg=env_config)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(config):
        processor.save_pretrained(folder)
    return folder


def write_train_config(folder: Path, **config) -> Path:
    """What a training leaves beside its policy, in a folder that is returned."""
    (folder / "train_config.json").write_text(json.dumps(config))
    return folder


def record_one(root: Path, **env_options) -> Path:
    """A demonstration of the task that comes first, from the state."""
    env = CronosEnvConfig(**STATE, num_threads=1, **env_options)
    record_demos(RecordDemosConfig(env=env, dataset=DemoDatasetConfig("me/demos", root, 1), num_envs=1))
    return root
