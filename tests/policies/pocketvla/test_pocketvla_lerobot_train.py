"""`lerobot-train` end to end, as a user would call it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from forked_commands import run_forked
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


def test_a_checkpoint_acts_in_physical_units_and_keeps_the_meaning_of_its_bins(dataset_root, tmp_path):
    """LeRobot replaces the normaliser's statistics by the new data set's; the action bounds must survive."""
    first, second = (tmp_path / name / "checkpoints/last/pretrained_model" for name in ("first", "second"))
    for output, flags in (
        ("first", ("--policy.type=pocketvla", "--steps=2")),
        ("second", (f"--policy.path={first}", "--steps=1")),
    ):
        done = lerobot_train(dataset_root, tmp_path / output, *flags)
        assert done.returncode == 0, done.stderr[-4000:]
    policy = PocketVLAPolicy.from_pretrained(second)
    assert policy.encoder is not None
    preprocessor, postprocessor = make_pre_post_processors(policy.config, pretrained_path=str(second))
    low = [-0.0287273, -0.0417035, -0.0260939, -0.0809211, -0.092887, -0.2071828, 0.0]
    high = [0.0283097, 0.0408553, 0.0401616, 0.0819205, 0.0779285, 0.2038257, 1.0]
    ends = postprocessor(torch.tensor([[-1.0] * 7, [1.0] * 7]))
    np.testing.assert_allclose(ends, [low, high], atol=1e-6)
    seen = {CAMERA: torch.rand(2, 3, 128, 128), "observation.state": torch.zeros(2, 13), "task": list(TASKS)}
    action = postprocessor(policy.select_action(preprocessor(seen))).numpy()
    assert action.shape == (2, 7)
    assert np.all((action[:, :6] > low[:6]) & (action[:, :6] < high[:6]))
    gripper = action[:, 6]
    assert np.all((gripper < 0.01) | (gripper > 0.99))
