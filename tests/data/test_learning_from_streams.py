"""Demonstrations and a run's own successes, merged by LeRobot, learned from by LeRobot: its own commands."""

import json
import sys

import numpy as np
from forked_commands import run_forked
from lerobot.datasets import LeRobotDataset
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from lerobot_env_cronos.expert.expert import ScriptedExpert
from synthetic_streams import make_step

from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos

SIZE = {"observation_height": 64, "observation_width": 64}
K, STREAMS = 40, 4
COMMANDS = """
import sys
from lerobot.scripts.lerobot_edit_dataset import main as edit
from lerobot.scripts.lerobot_train import main as train
from cronos_lerobot.scripts.streams import main as streams
folder = sys.argv[1]
datasets = f"['{folder}/demos', '{folder}/successes']"
for main, *flags in (
    (streams, "filter", "--dataset.repo_id=me/stream", f"--dataset.root={folder}/stream", "--filter.success=true",
     "--frames_after_success=3", "--output.repo_id=me/successes", f"--output.root={folder}/successes"),
    (edit, "--operation.type=merge", "--operation.repo_ids=['me/demos', 'me/successes']",
     f"--operation.roots={datasets}", "--new_repo_id=me/both", f"--new_root={folder}/both"),
    (train, "--policy.type=pocketvla", "--policy.device=cpu", "--policy.push_to_hub=false", "--num_workers=0",
     "--batch_size=4", "--steps=2", "--wandb.enable=false", "--dataset.repo_id=me/both",
     f"--dataset.root={folder}/both", f"--output_dir={folder}/run"),
):
    sys.argv[1:] = flags
    main()
"""


def record_stream(root) -> None:
    """Two segments of each stream, which the expert does."""
    env = CronosVectorEnv(STREAMS, num_threads=1, **SIZE)
    recorder = StreamRecorder.open(env, "me/stream", root, segment_length=K, describes=())
    expert, everyone = ScriptedExpert(env), np.arange(STREAMS)
    for t in range(2 * K):
        if t % K == 0:
            env.set_task(everyone, [env.scene.tasks[(t // K + i) % 4] for i in everyone])
            expert.reset(everyone)
        observation, action = env.observe(), expert.act().astype(np.float32)
        _, reward, _, _, info = env.step(action)
        kind = Intervention.NONE if t % K else Intervention.TASK_SWITCH if t else Intervention.INITIAL
        step = make_step(
            t, observation=observation, instructions=env.instructions, actions=action, reward=reward,
            success=info["is_success"], log_prob=None, value=None, preceded_by=np.full(STREAMS, kind),
            piece=np.full(STREAMS, t // K), cut=np.full(STREAMS, t % K == K - 1),
            segments_since_reset=np.full(STREAMS, t // K),
        )  # fmt: skip
        recorder.on_step(step)
    recorder.close()
    env.close()


def test_own_successes_beside_demonstrations(tmp_path):
    dataset = DemoDatasetConfig("me/demos", tmp_path / "demos", 4)
    record_demos(RecordDemosConfig(env=CronosEnvConfig(num_threads=1, **SIZE), dataset=dataset, num_envs=4))
    record_stream(tmp_path / "stream")
    done = run_forked([sys.executable, "-c", COMMANDS, str(tmp_path)])
    assert done.returncode == 0, done.stderr[-4000:]
    successes = LeRobotDataset("me/successes", root=tmp_path / "successes")
    assert successes.num_episodes >= 2
    assert LeRobotDataset("me/both", root=tmp_path / "both").num_episodes == 4 + successes.num_episodes
    config = json.loads((tmp_path / "run/checkpoints/last/pretrained_model/config.json").read_text())
    assert set(config["input_features"]) == {"observation.images.front", "observation.state"}
    assert set(config["output_features"]) == {"action"}
