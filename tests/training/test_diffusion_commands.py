"""A Diffusion policy from LeRobot's command to ours and back to LeRobot's."""

import json
import sys

from forked_commands import run_forked
from lerobot_env_cronos import CronosEnvConfig
from test_cronos_train import cronos_train

from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos

ENV = ("--env.type=cronos", "--env.obs_type=environment_state_agent_pos", "--env.task_observation=one_hot")


def lerobot(script, *flags):
    command = [sys.executable, "-m", f"lerobot.scripts.{script}", "--policy.device=cpu", *flags]
    done = run_forked(command)
    assert done.returncode == 0, done.stderr[-3000:]


def test_cloned_by_lerobot_trained_here_played_by_lerobot(tmp_path, monkeypatch):
    env = CronosEnvConfig(obs_type="environment_state_agent_pos", task_observation="one_hot")
    record_demos(
        RecordDemosConfig(env=env, dataset=DemoDatasetConfig("me/demos", tmp_path / "demos", 2), num_envs=2)
    )
    lerobot(
        "lerobot_train", "--policy.type=diffusion", "--policy.push_to_hub=false", "--dataset.repo_id=me/demos",
        f"--dataset.root={tmp_path / 'demos'}", f"--output_dir={tmp_path / 'clone'}", "--steps=2",
        "--batch_size=4", "--num_workers=0", "--policy.down_dims=[8,16]", "--policy.n_groups=4",
        "--policy.horizon=8", "--policy.n_action_steps=4", "--policy.diffusion_step_embed_dim=8",
    )  # fmt: skip
    clone = tmp_path / "clone/checkpoints/last/pretrained_model"
    assert json.loads((clone / "config.json").read_text())["noise_scheduler_type"] == "DDPM"
    # The schedule is the same: five steps of DDIM where there were a hundred of DDPM.
    cronos_train(
        monkeypatch, f"--policy.path={clone}", "--policy.noise_scheduler_type=DDIM",
        "--policy.num_inference_steps=5", "--policy.device=cpu", "--policy.push_to_hub=false", *ENV,
        "--num_envs=2",
        "--protocol.task_switch_interval=8", "--protocol.update_interval=8", "--steps=16", "--eval_freq=0",
        "--algorithm.value_warmup_updates=0", "--algorithm.ratio=factor",
        "--algorithm.denoising_discount=0.9", f"--output_dir={tmp_path / 'run'}",
    )  # fmt: skip
    trained = tmp_path / "run/checkpoints/last/pretrained_model"
    config = json.loads((trained / "config.json").read_text())
    assert (config["noise_scheduler_type"], config["num_inference_steps"]) == ("DDIM", 5)
    lerobot(
        "lerobot_eval", f"--policy.path={trained}", *ENV, "--env.task=put the ketchup bottle on the cloth",
        "--env.render_size=[32, 32]", "--eval.n_episodes=1", "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'out'}",
    )  # fmt: skip
    info = json.loads((tmp_path / "out/eval_info.json").read_text())
    assert len(info["per_task"][0]["metrics"]["sum_rewards"]) == 1
