"""`cronos-train` on the real scene with the real policy, far too short to learn anything."""

import json
import os
import re
import signal
import sys
from pathlib import Path

import pytest
import torch
from forked_commands import run_forked
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils import auto_select_torch_device
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig
from safetensors.torch import load_file

from cronos_lerobot.hub.runs import find_checkpoint, read_run
from cronos_lerobot.locks import FolderLock
from cronos_lerobot.scripts import train as script

SMALL = (
    "--policy.type=pocketvla", "--policy.device=cpu", "--policy.hidden_width=16", "--policy.hidden_depth=1",
    "--env.type=cronos", "--num_envs=2", "--protocol.task_switch_interval=4", "--protocol.update_interval=8",
    "--protocol.scene_reset_interval=8", "--steps=32", "--save_freq=16", "--eval_freq=0", "--tensorboard=false",
    "--algorithm.minibatch_size=8", "--algorithm.value_warmup_updates=0", "--algorithm.entropy_coef=0.1",
)  # fmt: skip
OBSERVATIONS = {
    "state": ("--env.obs_type=environment_state_agent_pos",),
    "pixels": ("--env.observation_height=64", "--env.observation_width=64", "--env.num_threads=2"),
}


def cronos_train(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-train", *map(str, arguments)])
    script.main()


def weights(folder):
    return load_file(folder / "checkpoints/last/pretrained_model/model.safetensors")


def optimizer_state(checkpoint):
    return load_file(checkpoint / "training_state/optimizer_state.safetensors")


STOPPED = """
import os, signal, sys, threading, time
from pathlib import Path
from lerobot_env_cronos.simulation import render_pool, rendering

from cronos_lerobot.scripts import train

# Two frames are drawn by two processes.
rendering.MIN_FRAMES = render_pool.MIN_FRAMES = 1
folder = Path(sys.argv.pop(1))
# As a cluster does: to all processes, those that draw among them.
os.setsid()

def stop():
    while not list(folder.glob("checkpoints/*")):
        time.sleep(0.01)
    os.killpg(0, signal.SIGTERM)

threading.Thread(target=stop, daemon=True).start()
train.main()
"""


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_a_run_that_is_told_to_stop_saves_and_resumes(observation, tmp_path, monkeypatch):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    flags = (*SMALL, *OBSERVATIONS[observation], f"--output_dir={broken}", "--steps=100000", "--save_freq=16")
    stopped = run_forked([sys.executable, "-c", STOPPED, broken, *flags])
    assert stopped.returncode == -signal.SIGTERM, stopped.stderr
    assert "SIGTERM: ending after this update, with a checkpoint" in stopped.stderr
    last = broken / "checkpoints/last"
    steps = int(last.resolve().name)
    lines = [json.loads(line) for line in (broken / "metrics.jsonl").read_text().splitlines()]
    assert [line["interaction_steps"] for line in lines if line["kind"] == "update"][-1] == steps < 100_000
    before = weights(broken)
    end = f"--steps={steps + 16}"
    cronos_train(monkeypatch, "--resume=true", f"--config_path={last}/pretrained_model/train_config.json", end)
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS[observation], f"--output_dir={whole}", end)
    after = weights(broken)
    assert any(not torch.equal(before[name], after[name]) for name in before)
    for name, tensor in weights(whole).items():
        assert torch.equal(tensor, after[name]), name
    # Not given, PyTorch's own number of threads is on record, and a resumed run takes it from there.
    starts = json.loads((broken / "manifest.json").read_text())["starts"]
    assert [start["config"]["torch_threads"] for start in starts] == [torch.get_num_threads()] * 2


@pytest.mark.parametrize("device", [(), ("--policy.device=cpu",)])
def test_a_run_of_a_gpu_goes_on_on_a_cpu(device, tmp_path, monkeypatch, capsys):
    """Its generators of torch have a state that none of a CPU has: 16 bytes. Everything else is where it was."""
    flags = [flag for flag in SMALL if not flag.startswith("--steps")]
    run = tmp_path / "run"
    cronos_train(monkeypatch, *flags, *OBSERVATIONS["state"], "--steps=16", f"--output_dir={run}")
    last = run / "checkpoints/last"
    loop = json.loads((last / "training_state/loop.json").read_text())
    assert loop["generators"]["torch"]
    loop["generators"]["torch"] = {name: [1] * 16 for name in loop["generators"]["torch"]}
    (last / "training_state/loop.json").write_text(json.dumps(loop))
    for name in ("training_state/run.json", "pretrained_model/train_config.json"):
        text = (last / name).read_text()
        (last / name).write_text(text.replace('"device": "cpu"', '"device": "cuda"'))
        assert text.count('"device": "cpu"') == 1
    # PyTorch's choice on a GPU.
    groups = (last / "training_state/optimizer_param_groups.json").read_text()
    assert groups.count('"fused": true') == 2
    (last / "training_state/optimizer_param_groups.json").write_text(
        groups.replace('"fused": true', '"fused": null')
    )
    if not device and auto_select_torch_device().type != "cpu":
        pytest.skip("it would go on with the GPU")
    before, taken = weights(run), optimizer_state(last)
    resumed = ("--resume=true", f"--config_path={last}/pretrained_model/train_config.json", *device)
    cronos_train(monkeypatch, *resumed, "--steps=32")
    printed = "".join(capsys.readouterr())
    assert "This run began on cuda and goes on with cpu" in printed
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["interaction_steps"] for line in lines if line["kind"] == "update"] == [16, 32]
    assert any(not torch.equal(tensor, before[name]) for name, tensor in weights(run).items())
    # The moments went on, and its steps are computed as on a CPU.
    done = {name: int(value) for name, value in optimizer_state(last).items() if name.endswith("/step")}
    assert done
    assert all(steps > taken[name] > 0 for name, steps in done.items())
    assert (last / "training_state/optimizer_param_groups.json").read_text().count('"fused": true') == 2


def test_checkpoint_is_a_lerobot_policy(tmp_path, monkeypatch):
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], f"--output_dir={tmp_path / 'run'}", "--steps=16")
    register_third_party_plugins()
    from lerobot.configs import PreTrainedConfig

    folder = tmp_path / "run/checkpoints/last/pretrained_model"
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    env_config = CronosEnvConfig(obs_type="environment_state_agent_pos")
    policy = make_policy(config, env_cfg=env_config)
    preprocessor, postprocessor = make_pre_post_processors(config, str(folder))
    observation = {"observation.state": torch.zeros(3, 13), "observation.environment_state": torch.zeros(3, 48)}
    action = postprocessor(policy.select_action(preprocessor(observation | {"task": ["put it there"] * 3})))
    assert action.shape == (3, 7)


def test_strategy_and_order_of_the_docs(tmp_path):
    """The example of docs/extending.md, word for word, as a package of a user's."""
    docs = (Path(__file__).parents[2] / "docs/extending.md").read_text()
    code = re.search(r"```python\n(import numpy.*?register_reset.*?)```", docs, re.DOTALL)
    assert code is not None
    package = tmp_path / "my_protocol"
    package.mkdir()
    (package / "__init__.py").write_text(code[1])
    output = tmp_path / "run"
    command = [
        "cronos-train", *SMALL, *OBSERVATIONS["state"], "--protocol.discover_packages_path=my_protocol",
        "--protocol.extra_resets=[stuck]", "--protocol.task_order=weaker_more_often",
        "--protocol.scene_reset_interval=null", "--protocol.heuristic_reset=true", f"--output_dir={output}",
        "--steps=48",
    ]  # fmt: skip
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    run_forked(command, check=True, env=os.environ | {"PYTHONPATH": path})
    last = json.loads((output / "metrics.jsonl").read_text().splitlines()[-1])
    # Two streams of 24 steps: six segments, all failed, so that the fourth switch resets both.
    assert last["interventions_by_kind"]["scene_reset"] == 2
    assert last["interventions_by_stream"] == [last["interventions"] // 2] * 2
    assert last["interventions_by_kind"]["task_switch"] == 12


def test_agent_of_the_docs(tmp_path):
    """The example of docs/extending.md, word for word: it learns, and a resumed run is the unbroken one."""
    docs = (Path(__file__).parents[2] / "docs/extending.md").read_text()
    code = re.search(
        r"```python\n(from dataclasses import dataclass\n\nimport torch.*?register_agent.*?)```", docs, re.DOTALL
    )
    assert code is not None
    assert len([line for line in code[1].splitlines() if line]) <= 40
    package = tmp_path / "my_agent"
    package.mkdir()
    (package / "__init__.py").write_text(code[1])
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])

    def run(*flags):
        run_forked(["cronos-train", *flags], check=True, env=os.environ | {"PYTHONPATH": path})

    small = [flag for flag in SMALL if not flag.startswith("--algorithm.")]
    # Every action is cloned: no task is complete so early.
    agent = ("--discover_packages_path=my_agent", "--algorithm.type=rewarded", "--algorithm.threshold=-9")
    flags = (*small, *OBSERVATIONS["state"], *agent)
    run(*flags, f"--output_dir={tmp_path / 'whole'}")
    run(*flags, f"--output_dir={tmp_path / 'broken'}", "--steps=16")
    before = weights(tmp_path / "broken")
    last = tmp_path / "broken/checkpoints/last/pretrained_model"
    # The run's manifest has the plugin.
    run("--resume=true", f"--config_path={last}/train_config.json", "--steps=32")
    after = weights(tmp_path / "whole")
    assert any(not torch.equal(before[name], after[name]) for name in before)
    for name, tensor in weights(tmp_path / "broken").items():
        assert torch.equal(tensor, after[name]), name
    updates = [json.loads(line) for line in (tmp_path / "whole/metrics.jsonl").read_text().splitlines()]
    # Two streams, 8 steps an update.
    assert [line["agent"]["frames"] for line in updates] == [16, 16]


def test_policy_of_another_kind_is_refused(tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=r"^error: .*sample_actions.*--policy.type=act.*=imitation"):
        cronos_train(
            monkeypatch, "--policy.type=vqbet", "--policy.device=cpu", "--policy.pretrained_backbone_weights=null",
            "--env.type=cronos", "--num_envs=2", f"--output_dir={tmp_path / 'run'}",
        )  # fmt: skip


def test_what_cannot_be_is_one_line(tmp_path, monkeypatch):
    """A finished run, resumed or begun from in ways that do not fit it."""
    run = tmp_path / "run"
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], f"--output_dir={run}", "--steps=16")
    last = run / "checkpoints/last/pretrained_model"
    (start,) = json.loads((run / "manifest.json").read_text())["starts"]
    assert start["environment"] == "lerobot_env_cronos/kitchen_2x2-v1"
    assert len(start["benchmark"]["fingerprint"]) == 16
    # It began with a policy of its own, not with one in a folder.
    assert start["policy_fingerprint"] is None
    assert "--algorithm.type=ppo" not in start["command"]

    def refused(message, *arguments):
        with pytest.raises(SystemExit, match=message) as ended:
            cronos_train(monkeypatch, *arguments)
        assert str(ended.value).startswith("error: ")
        assert "\n" not in str(ended.value)

    resume = ("--resume=true", f"--config_path={last}/train_config.json", "--steps=32")
    scene = "--env.scene=playroom_2x2"
    refused(f"{scene}, but the run that is resumed has kitchen_2x2", *resume, scene)
    refused("--policy.type=act, but .* has pocketvla", *resume, "--policy.type=act")
    refused("--policy.path=/other, but", *resume, "--policy.path=/other")
    refused("--algorithm.type=ppo_paper, but .* has ppo ", *resume, "--algorithm.type=ppo_paper")
    refused("--output_dir=.*/elsewhere, but", *resume, f"--output_dir={tmp_path / 'elsewhere'}")
    with FolderLock(run):
        refused("run is being written by process", *resume)
    metrics = (run / "metrics.jsonl").read_bytes()
    (run / "metrics.jsonl").write_bytes(b"")
    refused("metrics.jsonl has 0 bytes, .* when the checkpoint was made", *resume)
    (run / "metrics.jsonl").write_bytes(metrics)
    assert len(json.loads((run / "manifest.json").read_text())["starts"]) == 1

    begin = (
        f"--policy.path={last}", "--policy.device=cpu", *OBSERVATIONS["state"], "--env.type=cronos",
        "--num_envs=2", f"--output_dir={tmp_path / 'new'}",
    )  # fmt: skip
    refused("environment_state of 48 numbers, kitchen_3x3 has 72", *begin, "--env.scene=kitchen_3x3")
    config = last / "config.json"
    text = config.read_text()
    content = json.loads(text)
    content["output_features"]["action"]["shape"] = [6]
    config.write_text(json.dumps(content))
    refused("the policy was made for action of 6 numbers, kitchen_2x2 has 7", *begin)
    config.write_text(text[:50])
    refused("pretrained_model/config.json is damaged", *begin)
    config.write_text(text)
    (last / "model.safetensors").write_bytes(b"short")
    refused("model.safetensors", *begin)
    assert not (tmp_path / "new").exists()


def test_a_budget_between_two_updates_is_no_end(tmp_path, monkeypatch, capfd):
    """T = K: the budget of one reset of both streams is spent after half a rollout."""
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    common = (*SMALL, *OBSERVATIONS["state"], "--protocol.scene_reset_interval=4")
    cronos_train(monkeypatch, *common, f"--output_dir={whole}")
    assert "The run ends after" not in capfd.readouterr().err
    cronos_train(monkeypatch, *common, f"--output_dir={stopped}", "--protocol.reset_budget=2")
    assert "its 2 interventions reach --protocol.reset_budget=2." in capfd.readouterr().err
    last = (stopped / "checkpoints/last").resolve()
    assert last.name == "000008"
    found = find_checkpoint(stopped)
    assert (found.step, read_run(stopped, found.step).last["interventions"]) == (8, 2)
    cronos_train(
        monkeypatch, "--resume=true", f"--config_path={last}/pretrained_model", "--protocol.reset_budget=null"
    )
    # The run went on from it.
    assert find_checkpoint(last).step == 8
    for name, tensor in weights(whole).items():
        assert torch.equal(tensor, weights(stopped)[name]), name
