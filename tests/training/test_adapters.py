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
from tiny_checkpoints import save_policy
from tiny_smolvla import pretend_num2words, save_tiny_smolvlm

from cronos_lerobot.agents.adapters.registry import AdapterOptions, make_trainable

FLAGS = (
    *(flag for flag in ACT if not flag.startswith(("--algorithm.", "--policy.n_action_steps"))),
    "--policy.n_action_steps=5", "--algorithm.type=ppo", "--algorithm.value_warmup_updates=0",
    "--algorithm.ratio=factor", "--algorithm.minibatch_size=8",
)  # fmt: skip
DIFFUSION = (
    "--policy.type=diffusion", "--policy.device=cpu", "--policy.n_obs_steps=2", "--policy.horizon=8",
    "--policy.n_action_steps=5", "--policy.drop_n_last_frames=1", "--policy.down_dims=[8,16]",
    "--policy.n_groups=4", "--policy.diffusion_step_embed_dim=8", "--policy.num_inference_steps=2",
    *(flag for flag in FLAGS if not flag.startswith("--policy.")),
)  # fmt: skip
ACT_ALONE = """
import json, sys
sys.modules["cronos_lerobot"] = None
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import get_policy_class
config = PreTrainedConfig.from_pretrained(sys.argv[1])
policy = get_policy_class(config.type).from_pretrained(sys.argv[1], config=config)
torch.manual_seed(0)
batch = {name: torch.rand(2, *feature.shape) for name, feature in config.input_features.items()}
noise = {"noise": torch.randn(2, 8, 7)} if config.type == "diffusion" else {}
policy.reset()
print(json.dumps([policy.select_action(batch, **noise).tolist() for _ in range(config.n_action_steps)]))
"""
"""Plays a chunk, without this project."""


def actions_alone(folder):
    """(n, 2, 7) actions of LeRobot's policy in a process that has only LeRobot."""
    acted = run_forked([sys.executable, "-c", ACT_ALONE, folder], check=True)
    return json.loads(acted.stdout.splitlines()[-1])


def actions_here(policy):
    """The same by the adapter, at noise level 0."""
    adapter = make_trainable(policy, AdapterOptions())
    torch.manual_seed(0)
    batch = {name: torch.rand(2, *feature.shape) for name, feature in adapter.config.input_features.items()}
    noise = {}
    if adapter.config.type == "diffusion":
        noise = {"noise": torch.randn(2, 8, 7)}
        # Of its first observation LeRobot makes both.
        batch = {name: torch.stack([value, value], 1) for name, value in batch.items()}
    with torch.no_grad():
        actions = adapter.sample_actions(batch, temperature=0, **noise)["actions"]
    return actions[:, : adapter.config.n_action_steps].transpose(0, 1).tolist()


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
    assert actions_alone(last) == actions_here(policy)


@pytest.mark.usefixtures("paid_for_moving")
def test_diffusion_learns_by_its_chain_saves_resumes_and_is_a_lerobot_policy(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"--policy\.noise_scheduler_type=DDIM"):
        cronos_train(monkeypatch, *DIFFUSION, "--steps=80", f"--output_dir={tmp_path / 'ddpm'}")
    flags = (*DIFFUSION, "--policy.noise_scheduler_type=DDIM", "--steps=160")
    names, last = learns(monkeypatch, tmp_path / "run", *flags)
    assert names == load_file(last / "model.safetensors").keys()

    from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

    assert actions_alone(last) == actions_here(DiffusionPolicy.from_pretrained(last))


def test_chunks_that_reach_beyond_a_switch_are_refused(tmp_path, monkeypatch):
    flags = [flag.replace("n_action_steps=5", "n_action_steps=3") for flag in FLAGS]
    with pytest.raises(SystemExit, match=r"--policy\.n_action_steps"):
        cronos_train(monkeypatch, *flags, "--steps=80", f"--output_dir={tmp_path / 'run'}")


SMOLVLA = {
    "chunk_size": 6, "n_action_steps": 5, "num_steps": 3, "num_vlm_layers": 2, "resize_imgs_with_padding": (32, 32)
}  # fmt: skip
VLA_FLAGS = (
    "--policy.device=cpu", "--env.type=cronos", *OBSERVATIONS["pixels"], "--num_envs=2",
    "--protocol.task_switch_interval=10", "--protocol.update_interval=10", "--protocol.scene_reset_interval=10",
    "--save_freq=20", "--eval_freq=0", "--tensorboard=false", "--algorithm.value_warmup_updates=0",
    "--algorithm.ratio=factor", "--algorithm.minibatch_size=4",
)  # fmt: skip
EVALUATE = """
from tiny_smolvla import pretend_num2words
pretend_num2words()
from lerobot.scripts.lerobot_eval import main
main()
"""


@pytest.fixture
def clone(tmp_path):
    pretend_num2words()
    save_tiny_smolvlm(tmp_path / "vlm")
    pixels = {"observation_height": 64, "observation_width": 64}
    return save_policy(tmp_path / "clone", "smolvla", pixels, vlm_model_name=str(tmp_path / "vlm"), **SMOLVLA)


@pytest.mark.usefixtures("paid_for_moving")
def test_smolvla_learns_from_pixels_saves_resumes_and_is_a_lerobot_policy(clone, tmp_path, monkeypatch):
    flags = (
        f"--policy.path={clone}",
        *VLA_FLAGS,
        "--algorithm.critic_observation=environment_state",
        "--algorithm.noise_steps=2",
        "--steps=40",
    )
    names, last = learns(monkeypatch, tmp_path / "run", *flags)
    assert [name for name in names if "lm_expert" in name]
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
def test_lora_learns_saves_resumes_and_is_a_lerobot_policy(clone, tmp_path, monkeypatch):
    run, file = tmp_path / "run", "adapter_model.safetensors"
    flags = (f"--policy.path={clone}", *VLA_FLAGS, "--peft.r=2", "--steps=40")

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
