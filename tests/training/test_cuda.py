"""`cronos-train`, `cronos-eval` and `accelerate launch` with policies on a GPU; skipped where there is none."""

import json
import sys

import numpy as np
import pytest
import torch
from forked_commands import run_forked
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot_env_cronos import CronosEnvConfig
from runs import metrics, weights
from safetensors.torch import load_file
from test_adapters import DIFFUSION, FLAGS, VLA_FLAGS
from test_cronos_train import OBSERVATIONS, SMALL, cronos_train, train_and_resume
from test_flow_head import TINY, TRAIN
from test_steering_commands import STEERED
from tiny_pi0 import tiny_gemma
from tiny_vlas import save_clone

from cronos_lerobot.agents.steering.steered import STEERING
from cronos_lerobot.scripts import eval as cronos_eval
from cronos_lerobot.training.checkpoint import read_state

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch finds no CUDA GPU")

FLOW = ("--policy.type=pocketvla", "--policy.head=flow", *TINY, *TRAIN)


KINDS = {
    "pocketvla from the state": (None, (*SMALL, *OBSERVATIONS["state"]), 32),
    "pocketvla from pixels": (None, (*SMALL, *OBSERVATIONS["pixels"]), 32),
    "its flow head": (None, (*FLOW, *OBSERVATIONS["state"]), 40),
    "act": (None, FLAGS, 160),
    "diffusion": (None, DIFFUSION, 160),
    "smolvla": ("smolvla", (*VLA_FLAGS, "--algorithm.critic_observation=environment_state"), 40),
    "smolvla with lora": ("smolvla", (*VLA_FLAGS, "--peft.r=2"), 40),
    "smolvla steered": ("smolvla", STEERED, 40),
    "pi0": ("pi0", VLA_FLAGS, 40),
}
"""The tiny policy that it begins with, flags on a CPU, and the steps of two updates or more, half until a save."""


def steps_of(optimizer):
    """How many steps each parameter has had."""
    if "param_groups" not in optimizer:
        return {name: steps_of(part) for name, part in optimizer.items()}
    return {index: int(values["step"]) for index, values in optimizer["state"].items()}


@pytest.mark.parametrize("kind", KINDS)
def test_it_trains_saves_resumes_and_is_evaluated(kind, tmp_path, monkeypatch):
    """A resumed run has the unbroken one's counters, generators and optimizer steps.

    Floats may differ by atomic additions.
    """
    tiny, flags, steps = KINDS[kind]
    flags = [flag.replace("device=cpu", "device=cuda") for flag in flags if not flag.startswith("--save_freq")]
    if tiny is not None:
        flags.append(f"--policy.path={save_clone(tiny, tmp_path)}")
    names = {"smolvla with lora": "adapter_model.safetensors", "smolvla steered": STEERING}

    def assert_alike(run, again):
        counted = ("kind", "interaction_steps", "interventions", "interventions_by_kind", "updates")
        one, other = ([{name: line[name] for name in counted} for line in metrics(one)] for one in (run, again))
        assert one == other != []
        states = [read_state(one / "checkpoints/last") for one in (run, again)]
        # That of a generator counts what it has drawn.
        assert states[0]["generators"] == states[1]["generators"]
        assert states[0]["generators"]["torch"]
        steps_taken = [steps_of(state["optimizer"]) for state in states]
        assert steps_taken[0] == steps_taken[1] != {}
        file = f"checkpoints/last/pretrained_model/{names.get(kind, 'model.safetensors')}"
        first, second = load_file(run / file), load_file(again / file)
        for tensor in first:
            torch.testing.assert_close(first[tensor], second[tensor], rtol=1e-2, atol=1e-3, msg=tensor)

    flags += [f"--save_freq={steps // 2}", f"--steps={steps}"]
    with tiny_gemma():
        _, last = train_and_resume(monkeypatch, tmp_path / "run", *flags, same=assert_alike)
        monkeypatch.setattr(sys, "argv", [
            "cronos-eval", f"--policy.path={last}", "--policy.device=cuda", "--eval.n_episodes=1",
            "--eval.videos=0", "--eval.suites=[independent]", "--eval.splits=[train]",
            f"--output_dir={tmp_path / 'evaluation'}",
            *(flag for flag in flags if flag.startswith("--env.task_observation")),
        ])  # fmt: skip
        cronos_eval.main()


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_a_run_goes_from_the_gpu_to_the_cpu_and_back(observation, tmp_path, monkeypatch):
    run = tmp_path / "run"
    flags = [flag.replace("device=cpu", "device=cuda") for flag in (*SMALL, *OBSERVATIONS[observation])]
    cronos_train(monkeypatch, *flags, "--steps=16", f"--output_dir={run}")
    seen = [weights(run)]
    for device, until in (("cpu", 32), ("cuda", 48)):
        last = run / "checkpoints/last/pretrained_model/train_config.json"
        resume = ("--resume=true", f"--config_path={last}", f"--policy.device={device}")
        cronos_train(monkeypatch, *resume, f"--steps={until}")
        seen.append(weights(run))
        assert all(torch.isfinite(tensor).all() for tensor in seen[-1].values())
        assert any(not torch.equal(tensor, seen[-2][name]) for name, tensor in seen[-1].items())
    assert [line["interaction_steps"] for line in metrics(run, "update")] == [16, 32, 48]


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_it_acts_as_on_a_cpu(observation, tmp_path, monkeypatch):
    run = tmp_path / "run"
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS[observation], "--steps=16", f"--output_dir={run}")
    folder = run / "checkpoints/last/pretrained_model"
    values = []
    for device in ("cpu", "cuda"):
        config = PreTrainedConfig.from_pretrained(folder)
        config.pretrained_path, config.device, config.dtype = folder, device, "float32"
        env_config = CronosEnvConfig(observation_height=64, observation_width=64)
        if observation == "state":
            env_config = CronosEnvConfig(obs_type="environment_state_agent_pos")
        policy = make_policy(config, env_cfg=env_config).eval()
        preprocessor, _ = make_pre_post_processors(
            config, str(folder), preprocessor_overrides={"device_processor": {"device": device}}
        )
        rng = np.random.default_rng(0)
        batch = {
            name: torch.from_numpy(rng.random((4, *feature.shape), dtype=np.float32))
            for name, feature in config.input_features.items()
        }
        batch = preprocessor(batch | {"task": ["put the ketchup bottle on the cloth"] * 4})
        with torch.no_grad():
            drawn = policy.sample_actions(batch, temperature=0)
        assert drawn["actions"].device.type == device
        values.append((drawn["actions"].cpu(), drawn["log_prob"].cpu(), drawn["value"].cpu()))
    for one, other in zip(*values, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3)


def test_accelerate_launch(tmp_path):
    """One process, for one GPU: gradients go through NCCL where there are more."""
    run = tmp_path / "run"
    flags = [flag.replace("device=cpu", "device=cuda") for flag in (*SMALL, *OBSERVATIONS["state"])]
    code = "from cronos_lerobot.scripts.train import main; main()"
    script = tmp_path / "train.py"
    script.write_text(code)
    launch = [
        sys.executable, "-m", "accelerate.commands.launch", "--num_processes=1", "--num_machines=1",
        "--mixed_precision=no", "--dynamo_backend=no", script, *flags, f"--output_dir={run}",
    ]  # fmt: skip
    done = run_forked(launch)
    assert done.returncode == 0, done.stderr[-3000:]
    manifest = json.loads((run / "manifest.json").read_text())
    assert manifest["starts"][0]["config"]["policy"]["device"] == "cuda"
    assert weights(run)
