"""Stock `lerobot-train` learns from a recorded stream by our weights, with SmolVLA and with PocketVLA."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from forked_commands import run_forked
from weighted_streams import CHUNK, GAMMA, WEIGHTS, record_weighted

from cronos_lerobot.data.stream_weights import write_progress
from cronos_lerobot.data.streams import StreamDataset

TRAIN = """
import json, sys
from pathlib import Path
from tiny_smolvla import pretend_num2words, save_tiny_smolvlm
pretend_num2words()
from lerobot.rewards.sarm.rabc import RABCWeights
from lerobot.scripts.lerobot_train import main

folder, chunk, common = Path(sys.argv[1]), sys.argv[2], sys.argv[3:]
save_tiny_smolvlm(folder / "vlm")
batches = []
compute = RABCWeights.compute_batch_weights
def compute_and_note(self, batch):
    weights, stats = compute(self, batch)
    batches[-1].append([batch["index"].tolist(), weights.tolist()])
    return weights, stats
RABCWeights.compute_batch_weights = compute_and_note
policies = {
    "smolvla": ["--policy.type=smolvla", f"--policy.vlm_model_name={folder / 'vlm'}", "--policy.num_vlm_layers=2",
                f"--policy.chunk_size={chunk}", f"--policy.n_action_steps={chunk}",
                "--policy.resize_imgs_with_padding=[32, 32]", "--policy.max_action_dim=7"],
    "tokens": ["--policy.type=pocketvla", "--policy.hidden_width=16", "--policy.hidden_depth=1"],
}
for name, flags in policies.items():
    batches.append([])
    sys.argv[1:] = [f"--output_dir={folder / name}", *common, *flags]
    main()
    print("RESULT", json.dumps([name, batches[-1]]))
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> dict:
    """One process for all policies: starting LeRobot takes longer than the training."""
    folder = tmp_path_factory.mktemp("weighted")
    record_weighted(folder / "streams")
    streams = StreamDataset("me/stream", folder / "streams", streaming=True)
    write_progress(streams, folder / "progress.parquet", GAMMA)
    flags = [
        *("--dataset.repo_id=me/stream", f"--dataset.root={folder / 'streams'}", "--policy.device=cpu"),
        *("--policy.push_to_hub=false", "--num_workers=0", "--batch_size=13", "--steps=2", "--wandb.enable=false"),
        *("--sample_weighting.type=rabc", f"--sample_weighting.progress_path={folder / 'progress.parquet'}"),
    ]
    tests = Path(__file__).parents[1]
    path = os.pathsep.join([str(tests), *filter(None, [os.environ.get("PYTHONPATH")])])
    command = [sys.executable, "-c", TRAIN, str(folder), str(CHUNK), *flags]
    done = run_forked(command, env=os.environ | {"PYTHONPATH": path})
    assert done.returncode == 0, done.stderr[-4000:]
    lines = [line.removeprefix("RESULT ") for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    return dict(map(json.loads, lines)) | {"folder": folder}


def test_a_policy_with_chunks_learns_with_the_weights_worked_out_by_hand(results):
    batches = results["smolvla"]
    by_hand = np.concatenate(WEIGHTS)
    # Two batches of 13 are every frame of the stream once.
    assert sorted(index for indices, _ in batches for index in indices) == list(range(26))
    for indices, weights in batches:
        expected = by_hand[indices]
        np.testing.assert_allclose(weights, expected * 13 / expected.sum(), atol=1e-4)
    assert (results["folder"] / "smolvla/checkpoints/last/pretrained_model/model.safetensors").is_file()


def test_a_policy_of_single_actions_looks_one_frame_ahead(results):
    weights = {
        index: weight for indices, found in results["tokens"] for index, weight in zip(indices, found, strict=True)
    }
    assert len(weights) == 26
    # It held its grasp for one step, then lost it: a small weight, then none.
    assert weights[8] > weights[9] == 0
