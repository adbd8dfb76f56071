"""`lerobot-train` end to end, as a user would call it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from forked_commands import run_forked
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot_policy_pocketvla import PocketVLAPolicy
from pocketvla_samples import CAMERA, TASKS


def lerobot_train(dataset_root: Path, output: Path, *flags: str) -> subprocess.CompletedProcess:
    command = [
        *(sys.executable, "-m", "lerobot.scripts.lerobot_train"),
        *("--dataset.repo_id=local/pocketvla", f"--dataset.root={dataset_root}", f"--output_dir={output}"),
        *("--policy.push_to_hub=false", "--policy.device=cpu", "--num_workers=0", "--batch_size=4"),
        *("--save_checkpoint=true", "--wandb.enable=false", "--env_eval_freq=0", *flags),
    ]
    return run_forked(command)


@pytest.fixture(scope="module")
def checkpoint(dataset_root, tmp_path_factory) -> Path:
    output = tmp_path_factory.mktemp("train") / "run"
    done = lerobot_train(dataset_root, output, "--policy.type=pocketvla", "--steps=3", "--log_freq=1")
    assert done.returncode == 0, done.stderr[-4000:]
    assert "step:3" in done.stderr + done.stdout
    return output / "checkpoints" / "last" / "pretrained_model"


def test_the_saved_checkpoint_acts_in_physical_units(checkpoint):
    config = PreTrainedConfig.from_pretrained(checkpoint)
    assert config.type == "pocketvla"
    policy = PocketVLAPolicy.from_pretrained(checkpoint)
    assert policy.uses_images
    preprocessor, postprocessor = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    batch = {
        CAMERA: torch.rand(2, 3, 128, 128),
        "observation.state": torch.zeros(2, 13),
        "task": list(TASKS),
    }
    action = postprocessor(policy.select_action(preprocessor(batch)))
    assert action.shape == (2, 7)
    low = np.array([-0.0288, -0.0418, -0.0261, -0.0810, -0.0929, -0.2072, 0.0])
    high = np.array([0.0284, 0.0409, 0.0402, 0.0820, 0.0780, 0.2039, 1.0])
    assert np.all((action.numpy() > low) & (action.numpy() < high))
    gripper = action[:, 6].numpy()
    assert np.all((gripper < 0.01) | (gripper > 0.99))


def test_training_on_from_a_checkpoint_keeps_the_meaning_of_the_bins(checkpoint, dataset_root, tmp_path):
    """LeRobot replaces the normaliser's statistics by the new data set's; the action bounds must survive."""
    done = lerobot_train(dataset_root, tmp_path / "run", f"--policy.path={checkpoint}", "--steps=1")
    assert done.returncode == 0, done.stderr[-4000:]
    again = tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"
    policy = PocketVLAPolicy.from_pretrained(again)
    _, postprocessor = make_pre_post_processors(policy.config, pretrained_path=str(again))
    top = postprocessor(torch.ones(1, 7))
    expected = [0.0283097, 0.0408553, 0.0401616, 0.0819205, 0.0779285, 0.2038257, 1.0]
    np.testing.assert_allclose(top[0].numpy(), expected, atol=1e-6)
