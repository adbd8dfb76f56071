"""`cronos-train --algorithm.type=steering` on the real scene, and `cronos-eval` of what it saves."""

import json
import sys

import pytest
import torch
from lerobot.configs import PreTrainedConfig
from runs import assert_same_run, metrics
from safetensors import safe_open
from safetensors.torch import load_file
from test_adapters import FLAGS, VLA_FLAGS
from test_cronos_train import OBSERVATIONS, SMALL, cronos_train, train_and_resume
from test_steering_runs import assert_same_actor
from tiny_vlas import save_clone

from cronos_lerobot.agents.steering.steered import STEERING, SteeredPolicy
from cronos_lerobot.evaluation.policy_source import fingerprint
from cronos_lerobot.scripts import eval as eval_script

STEERED = (
    *(flag for flag in VLA_FLAGS if not flag.startswith("--algorithm.")), "--algorithm.type=steering",
    "--algorithm.hidden_width=16", "--algorithm.batch_size=8", "--algorithm.warmup_decisions=4",
    "--algorithm.noise_repeat=true", "--algorithm.utd=1",
)  # fmt: skip


def assert_same_steering(run, again):
    assert_same_run(run, again)
    assert_same_actor(run, again)


def test_smolvla_is_steered_saved_resumed_and_evaluated(tmp_path, monkeypatch, caplog):
    clone = save_clone("smolvla", tmp_path)
    run = tmp_path / "run"
    flags = (f"--policy.path={clone}", *STEERED, "--steps=40")
    _, folder = train_and_resume(monkeypatch, run, *flags, same=assert_same_steering)
    # Two streams decide twice in an update of ten steps.
    updates = [line["agent"] for line in metrics(run, "update")]
    assert [(line["decisions"], line["optimizer_steps"]) for line in updates] == [(4, 4), (8, 4)]
    frozen = load_file(clone / "model.safetensors")
    for name, tensor in load_file(folder / "model.safetensors").items():
        assert torch.equal(tensor, frozen[name]), name
    assert fingerprint(policy_config(folder)) != fingerprint(policy_config(clone))

    asked, sample = [], SteeredPolicy.sample_actions
    monkeypatch.setattr(
        SteeredPolicy, "sample_actions", lambda *args, **kw: asked.append(1) or sample(*args, **kw)
    )
    for policy, steers in ((folder, True), (clone, False)):
        out = tmp_path / f"steered_{steers}"
        command = [
            "cronos-eval", f"--policy.path={policy}", "--policy.device=cpu", "--eval.n_episodes=1",
            "--eval.videos=0", "--eval.suites=[independent]", "--eval.splits=[train]", f"--output_dir={out}",
        ]  # fmt: skip
        monkeypatch.setattr(sys, "argv", command)
        asked.clear()
        eval_script.main()
        assert json.loads((out / "independent_train/results.json").read_text())["n"] == 4
        # 80 steps, five at a time, for all four tasks at once.
        assert len(asked) == (16 if steers else 0)


def test_pocketvlas_flow_head_is_steered_from_the_state(tmp_path, monkeypatch, capsys):
    flags = [flag for flag in (*SMALL, *OBSERVATIONS["state"]) if not flag.startswith("--algorithm.")]
    flags += [
        "--algorithm.type=steering",
        "--algorithm.utd=1",
        "--algorithm.batch_size=8",
        "--algorithm.warmup_decisions=8",
    ]
    run = tmp_path / "run"
    with pytest.raises(SystemExit, match=r"--policy\.head=gaussian makes no actions of noise.*head=flow"):
        cronos_train(monkeypatch, *flags, f"--output_dir={run}")
    flow = ["--policy.head=flow", "--policy.chunk_size=6", "--policy.n_action_steps=2", "--algorithm.utd=0.5"]
    cronos_train(monkeypatch, *flags, *flow, f"--output_dir={run}")
    # Two streams of four decisions in an update of eight steps.
    first = metrics(run)[0]["agent"]
    assert (first["decisions"], first["optimizer_steps"]) == (8, 4)
    with safe_open(run / "checkpoints/last/pretrained_model" / STEERING, "pt") as actor:
        shape = json.loads(actor.metadata()["shape"])
        # State, environment's state and words; the noise of six steps of seven dimensions, mean and deviation.
        assert (shape["observation"], shape["features"]) == ("state", 13 + 48 + 32)
        assert actor.get_slice("actor.head.bias").get_shape() == [2 * 6 * 7]

    # Whoever learns on from here is told that it is from the policy alone.
    steered = run / "checkpoints/last/pretrained_model"
    others = [flag for flag in flags if not flag.startswith(("--policy.", "--algorithm."))]
    others += ["--policy.device=cpu", "--algorithm.type=ppo", "--algorithm.minibatch_size=8", "--steps=16"]
    assert "steers the policy" not in capsys.readouterr().err
    cronos_train(monkeypatch, *others, f"--policy.path={steered}", f"--output_dir={tmp_path / 'on'}")
    assert "steers the policy" in capsys.readouterr().err
    learned = tmp_path / "on/checkpoints/last/pretrained_model"
    assert not (learned / STEERING).exists()
    resume = ("--resume=true", f"--config_path={steered}/train_config.json", "--steps=48")
    cronos_train(monkeypatch, *resume)
    assert "steers the policy" not in capsys.readouterr().err


def policy_config(folder):
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return config


def test_policies_without_noise_are_refused(tmp_path, monkeypatch):
    flags = [flag for flag in FLAGS if not flag.startswith("--algorithm.")]
    with pytest.raises(SystemExit, match=r"--policy\.type=act has no noise .*smolvla") as ended:
        cronos_train(
            monkeypatch, *flags, "--algorithm.type=steering", "--steps=80", f"--output_dir={tmp_path / 'run'}"
        )
    assert "\n" not in str(ended.value)
