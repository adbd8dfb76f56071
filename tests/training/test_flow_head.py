"""PocketVLA's flow head from demonstrations to an evaluation, by the commands."""

import json
import sys

import numpy as np
import pytest
import torch
from forked_commands import run_forked
from lerobot.policies import make_pre_post_processors
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from lerobot_policy_pocketvla import PocketVLAFlowPolicy, PocketVLAPolicy
from runs import metrics
from safetensors.torch import load_file
from test_adapters import paid_for_moving  # noqa: F401
from test_cronos_train import OBSERVATIONS, cronos_train, moved, starts, train_and_resume
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.agents.processing import make_processors
from cronos_lerobot.evaluation.independent import run_independent
from cronos_lerobot.scripts import eval as cronos_eval
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos

TINY = (
    "--policy.device=cpu", "--policy.hidden_width=16", "--policy.hidden_depth=1", "--policy.flow_width=16",
    "--policy.flow_depth=1", "--policy.num_inference_steps=3",
)  # fmt: skip
TRAIN = (
    "--env.type=cronos", "--num_envs=2", "--protocol.task_switch_interval=10", "--protocol.update_interval=10",
    "--protocol.scene_reset_interval=10", "--save_freq=20", "--eval_freq=0", "--tensorboard=false",
    "--algorithm.value_warmup_updates=0", "--algorithm.ratio=factor", "--algorithm.minibatch_size=4",
)  # fmt: skip
WITHOUT_US = """
import sys
sys.modules["cronos_lerobot"] = None
from lerobot.scripts.{command} import main
main()
"""


def lerobot(command, *flags):
    """One of LeRobot's commands, in a process that has the policy's and the scenes' packages, and not ours."""
    done = run_forked([sys.executable, "-c", WITHOUT_US.format(command=command), *flags])
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.usefixtures("paid_for_moving")
def test_cloned_trained_and_evaluated_by_the_commands(tmp_path, monkeypatch):
    demos = DemoDatasetConfig("me/demos", tmp_path / "demos", 2)
    record_demos(RecordDemosConfig(env=CronosEnvConfig(**STATE), dataset=demos, num_envs=2))
    lerobot(
        "lerobot_train", "--policy.type=pocketvla", "--policy.head=flow", *TINY, "--policy.push_to_hub=false",
        "--dataset.repo_id=me/demos", f"--dataset.root={tmp_path / 'demos'}", "--batch_size=8", "--steps=2",
        "--num_workers=0", f"--output_dir={tmp_path / 'clone'}",
    )  # fmt: skip
    clone = tmp_path / "clone/checkpoints/last/pretrained_model"
    flags = (f"--policy.path={clone}", *OBSERVATIONS["state"])
    run = tmp_path / "run"
    before, checkpoint = train_and_resume(monkeypatch, run, *flags, *TRAIN, "--steps=40")
    updates = [line["agent"] for line in metrics(run, "update")]
    assert len(updates) == 2
    assert all(update["policy_grad_norm"] > 0 and update["value_grad_norm"] > 0 for update in updates)
    # Which policy each start began with: the first one with the clone, the resumed one with its own checkpoint.
    (first,), (same, resumed) = (
        [one["policy_fingerprint"] for one in starts(f)] for f in (run, tmp_path / "run_again")
    )
    assert first == same != resumed
    assert len(first) == len(resumed) == 16
    names = moved(before, checkpoint)
    for part in ("actor.", "head.", "value_head.", "critic."):
        assert any(name.startswith(part) for name in names), part

    policy = PocketVLAPolicy.from_pretrained(checkpoint)
    assert isinstance(policy, PocketVLAFlowPolicy)
    assert policy.state_dict().keys() == load_file(checkpoint / "model.safetensors").keys()
    lerobot(
        "lerobot_eval", f"--policy.path={checkpoint}", "--policy.device=cpu", "--env.type=cronos",
        *OBSERVATIONS["state"], "--env.render_size=[32, 32]", "--env.task=put the ketchup bottle on the cloth",
        "--eval.n_episodes=1", "--eval.batch_size=1", f"--output_dir={tmp_path / 'out'}",
    )  # fmt: skip
    info = json.loads((tmp_path / "out/eval_info.json").read_text())
    assert len(info["per_task"][0]["metrics"]["sum_rewards"]) == 1

    monkeypatch.setattr(sys, "argv", [
        "cronos-eval", f"--policy.path={checkpoint}", "--policy.device=cpu", "--eval.n_episodes=1",
        "--eval.splits=[train]", "--eval.suites=[independent]", "--eval.videos=0",
        f"--output_dir={tmp_path / 'eval'}",
    ])  # fmt: skip
    cronos_eval.main()
    results = json.loads((tmp_path / "eval/independent_train/results.json").read_text())
    assert results["n"] == 4
    # Nothing is sampled at a temperature; the noise that a chunk begins with is the policy's own.
    assert results["temperature"] is None


def test_an_evaluation_repeats_with_its_seed(tmp_path):
    checkpoint = save_policy(tmp_path, "pocketvla", STATE, head="flow", hidden_width=16, flow_width=16)
    policy = PocketVLAPolicy.from_pretrained(checkpoint)
    processors = make_processors(policy, *make_pre_post_processors(policy.config, str(checkpoint)))
    env = CronosVectorEnv(2, **STATE)
    options = {"n_episodes": 1, "split": "train", "temperature": 0.6, "states": env.positions}
    paths = []
    for seed in (3, 3, 4):
        torch.rand(1)  # Whatever else was drawn.
        results = run_independent(env, policy, processors, seed=seed, **options)
        paths.append(np.stack([result.trajectory.states for result in results]))
    assert np.array_equal(paths[0], paths[1])
    assert not np.array_equal(paths[0], paths[2])


@pytest.mark.usefixtures("paid_for_moving")
def test_lora_in_every_layer_as_lerobot_train_has_it(tmp_path, monkeypatch):
    """Cloned by `lerobot-train --peft.*` and trained on from its adapters."""
    record_demos(
        RecordDemosConfig(
            env=CronosEnvConfig(**STATE), dataset=DemoDatasetConfig("me/demos", tmp_path / "demos", 2), num_envs=2
        )
    )
    sizes = {"hidden_width": 16, "hidden_depth": 1, "flow_width": 16, "flow_depth": 1, "num_inference_steps": 3}
    clone = save_policy(tmp_path / "clone", "pocketvla", STATE, head="flow", **sizes)
    lerobot(
        "lerobot_train", f"--policy.path={clone}", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--peft.r=2", "--peft.target_modules=all-linear", "--dataset.repo_id=me/demos",
        f"--dataset.root={tmp_path / 'demos'}", "--batch_size=8", "--steps=2", "--num_workers=0",
        f"--output_dir={tmp_path / 'adapted'}",
    )  # fmt: skip
    adapted = tmp_path / "adapted/checkpoints/last/pretrained_model"
    run = tmp_path / "run"
    cronos_train(
        monkeypatch, f"--policy.path={adapted}", "--policy.device=cpu", *OBSERVATIONS["state"], *TRAIN,
        "--steps=40", f"--output_dir={run}",
    )  # fmt: skip
    updates = [line["agent"] for line in metrics(run, "update")]
    assert all(update["policy_grad_norm"] > 0 and update["value_grad_norm"] > 0 for update in updates)
    first, last = (run / "checkpoints" / step / "pretrained_model" for step in ("000020", "last"))
    names = moved(first, last, "adapter_model.safetensors")
    assert all(".lora_" in name for name in load_file(last / "adapter_model.safetensors"))
    for part in (".head.", ".value_head.", ".critic."):
        assert [name for name in names if part in name], part
    assert not (last / "model.safetensors").exists()
