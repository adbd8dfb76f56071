"""LeRobot's own policies trained by PPO on the real scene."""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from forked_commands import run_forked
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from peft import get_peft_model_state_dict
from runs import metrics
from safetensors.torch import load_file
from test_cronos_train import OBSERVATIONS, cronos_train, moved, train_and_resume
from test_imitation import ACT
from test_imitation import OBSERVATIONS as ENVIRONMENT
from tiny_checkpoints import save_policy
from tiny_pi0 import tiny_gemma
from tiny_vlas import KINDS, save_clone

FLAGS = (
    *(flag for flag in ACT if not flag.startswith(("--algorithm.", "--policy.n_action_steps"))),
    "--policy.n_action_steps=5", "--algorithm.type=ppo", "--algorithm.value_warmup_updates=0",
    "--algorithm.ratio=factor", "--algorithm.minibatch_size=8",
)  # fmt: skip
TINY_DIFFUSION = {
    "n_obs_steps": 2, "horizon": 8, "n_action_steps": 5, "drop_n_last_frames": 1, "down_dims": [8, 16],
    "n_groups": 4, "diffusion_step_embed_dim": 8,
}  # fmt: skip
DENOISED_IN_TWO_STEPS = ("--policy.noise_scheduler_type=DDIM", "--policy.num_inference_steps=2")
DIFFUSION = (
    "--policy.type=diffusion", "--policy.device=cpu", *DENOISED_IN_TWO_STEPS,
    *(f"--policy.{name}={value}" for name, value in TINY_DIFFUSION.items()),
    *(flag for flag in FLAGS if not flag.startswith("--policy.")),
)  # fmt: skip


@pytest.fixture
def paid_for_moving(monkeypatch):
    """An untrained arm hardly ever grasps: it is paid for moving forwards, too."""
    step_streams = CronosVectorEnv.step_streams

    def step(env, actions, ids):
        reward, diverged = step_streams(env, actions, ids)
        return reward + np.clip(actions[:, 0], -1, 1), diverged

    monkeypatch.setattr(CronosVectorEnv, "step_streams", step)


def learns(monkeypatch, run, *flags):
    """A policy that PPO trains for two updates; the names that moved in the second, and its checkpoint."""
    first, last = train_and_resume(monkeypatch, run, *flags)
    updates = [line["agent"] for line in metrics(run, "update")]
    assert len(updates) == 2
    assert all(update["policy_grad_norm"] > 0 for update in updates)
    return moved(first, last), last


def test_act_learns_in_chunks_saves_resumes_and_is_a_lerobot_policy(tmp_path, monkeypatch):
    names, last = learns(monkeypatch, tmp_path / "run", *FLAGS, "--steps=160")
    assert names

    from lerobot.policies.act.modeling_act import ACTPolicy

    policy = ACTPolicy.from_pretrained(last)
    assert not [name for name in policy.state_dict() if "critic" in name or "log_std" in name]


@pytest.mark.usefixtures("paid_for_moving")
def test_diffusion_learns_by_its_chain_saves_resumes_and_is_a_lerobot_policy(tmp_path, monkeypatch):
    clone = save_policy(tmp_path / "clone", "diffusion", ENVIRONMENT, **TINY_DIFFUSION)
    assert json.loads((clone / "config.json").read_text())["noise_scheduler_type"] == "DDPM"
    # The schedule is the same: two steps of DDIM where there were a hundred of DDPM.
    flags = (
        f"--policy.path={clone}", "--policy.device=cpu", *DENOISED_IN_TWO_STEPS,
        *(flag for flag in DIFFUSION if not flag.startswith("--policy.")), "--steps=160",
    )  # fmt: skip
    names, last = learns(monkeypatch, tmp_path / "run", *flags)
    assert names == load_file(last / "model.safetensors").keys()

    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    config = DiffusionPolicy.from_pretrained(last).config
    assert (config.noise_scheduler_type, config.num_inference_steps) == ("DDIM", 2)


VLA_FLAGS = (
    "--policy.device=cpu", "--env.type=cronos", *OBSERVATIONS["pixels"], "--num_envs=2",
    "--protocol.task_switch_interval=10", "--protocol.update_interval=10", "--protocol.scene_reset_interval=10",
    "--save_freq=20", "--eval_freq=0", "--tensorboard=false", "--algorithm.value_warmup_updates=0",
    "--algorithm.ratio=factor", "--algorithm.minibatch_size=4",
)  # fmt: skip
EVALUATE = """
import sys
sys.modules["cronos_lerobot"] = None
from tiny_pi0 import tiny_gemma
from tiny_smolvla import pretend_num2words
pretend_num2words()
from lerobot.scripts.lerobot_eval import main
with tiny_gemma():
    main()
"""
OWN_FLAGS = {"smolvla": ("--algorithm.critic_observation=environment_state", "--algorithm.noise_steps=2")}
LEARNING = {
    "smolvla": ["lm_expert"],
    "pi0": ["gemma_expert", "vision_tower"],
    "pi05": ["gemma_expert", "vision_tower"],
}


@pytest.mark.usefixtures("paid_for_moving")
@pytest.mark.parametrize("kind", KINDS)
def test_a_vla_learns_from_pixels_saves_resumes_and_is_a_lerobot_policy(kind, tmp_path, monkeypatch):
    flags = (f"--policy.path={save_clone(kind, tmp_path)}", *VLA_FLAGS, *OWN_FLAGS.get(kind, ()), "--steps=40")
    with tiny_gemma():
        names, last = learns(monkeypatch, tmp_path / "run", *flags)
    for part in LEARNING[kind]:
        assert [name for name in names if part in name], part
    # What is frozen.
    assert not [name for name in names if ".vlm." in name]

    command = [
        sys.executable, "-c", EVALUATE, f"--policy.path={last}",
        "--policy.device=cpu", "--env.type=cronos", *OBSERVATIONS["pixels"], "--env.render_size=[32, 32]",
        "--env.task=put the ketchup bottle on the cloth", "--eval.n_episodes=1", "--eval.batch_size=1",
        f"--output_dir={tmp_path / 'out'}",
    ]  # fmt: skip
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    done = run_forked(command, env=os.environ | {"PYTHONPATH": path})
    assert done.returncode == 0, done.stderr[-3000:]
    info = json.loads((tmp_path / "out/eval_info.json").read_text())
    assert len(info["per_task"][0]["metrics"]["sum_rewards"]) == 1


@pytest.mark.usefixtures("paid_for_moving")
def test_lora_learns_saves_resumes_and_is_a_lerobot_policy(tmp_path, monkeypatch):
    run, file = tmp_path / "run", "adapter_model.safetensors"
    flags = (f"--policy.path={save_clone('smolvla', tmp_path)}", *VLA_FLAGS, "--peft.r=2", "--steps=40")

    def assert_same_adapters(run, again):
        model = "checkpoints/last/pretrained_model"
        assert metrics(run) == metrics(again)
        assert not moved(run / model, again / model, file)

    first, last = train_and_resume(monkeypatch, run, *flags, same=assert_same_adapters)
    assert moved(first, last, file)
    assert not (last / "model.safetensors").exists()
    resume = ("--resume=true", f"--output_dir={run}", "--steps=60")
    with pytest.raises(SystemExit, match=r"--peft\.r=4"):
        cronos_train(monkeypatch, *resume, "--peft.r=4")
    # The run's config is that of a run which begins without them.
    new = (f"--config_path={last}/train_config.json", "--steps=20", f"--output_dir={tmp_path / 'new'}")
    cronos_train(monkeypatch, *new)
    assert not moved(first, tmp_path / "new/checkpoints/last/pretrained_model", file)

    config = PreTrainedConfig.from_pretrained(last)
    config.pretrained_path = last
    policy = make_policy(config, env_cfg=CronosEnvConfig(observation_height=64, observation_width=64))
    trained = get_peft_model_state_dict(policy)
    assert all(torch.equal(trained[name], tensor) for name, tensor in load_file(last / file).items())
