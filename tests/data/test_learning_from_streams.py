"""`lerobot-train` on recorded streams as they are, and on what a filter made of them."""

import json
import sys

from forked_commands import run_forked
from synthetic_streams import record

from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.streams import StreamDataset

TRAIN_TWICE = """
import sys
from lerobot.scripts.lerobot_train import main
common = sys.argv[2:]
for name in ("streams", "successes"):
    root = f"{sys.argv[1]}/{name}"
    sys.argv[1:] = [f"--dataset.repo_id=me/{name}", f"--dataset.root={root}", f"--output_dir={root}_run", *common]
    main()
    sys.argv[1:2] = [root.rsplit("/", 1)[0]]
"""


def test_lerobot_trains_on_streams_and_on_filtered_ones(tmp_path):
    """One process for both: starting LeRobot takes longer than the training."""
    record(tmp_path / "streams", repo_id="me/streams")
    streams = StreamDataset("me/streams", tmp_path / "streams", streaming=True)
    filter_streams(
        streams, SegmentFilter(success=True), "me/successes", tmp_path / "successes", frames_after_success=1
    )
    command = [
        *(sys.executable, "-c", TRAIN_TWICE, str(tmp_path), "--policy.type=pocketvla", "--policy.device=cpu"),
        *("--policy.push_to_hub=false", "--num_workers=0", "--batch_size=4", "--steps=2", "--wandb.enable=false"),
    ]
    done = run_forked(command)
    assert done.returncode == 0, done.stderr[-4000:]
    for name in ("streams", "successes"):
        config = json.loads((tmp_path / f"{name}_run/checkpoints/last/pretrained_model/config.json").read_text())
        # The annotations are neither inputs nor outputs.
        assert set(config["input_features"]) == {"observation.images.front", "observation.state"}
        assert set(config["output_features"]) == {"action"}
