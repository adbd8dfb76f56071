"""`cronos-train` on the real scene with the real policy, far too short to learn anything."""

import json
import os
import re
import resource
import shutil
import signal
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from dummies import DummyPolicyConfig
from forked_commands import run_forked
from huggingface_hub.errors import LocalTokenNotFoundError
from lerobot_env_cronos import CronosEnvConfig
from runs import assert_same_run, assert_same_weights, metrics, weights
from safetensors.torch import load_file

from cronos_lerobot.locks import FolderLock
from cronos_lerobot.ranks import Ranks, choose_gpu
from cronos_lerobot.scripts import train as script
from cronos_lerobot.training.checkpoint import read_state
from cronos_lerobot.training.config import CronosTrainConfig

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


def train_and_resume(monkeypatch, run, *flags, same=assert_same_run):
    """Train; what goes on from the first checkpoint is the same run. Returns the first and the last policy."""
    cronos_train(monkeypatch, *flags, f"--output_dir={run}")
    again = run.with_name(f"{run.name}_again")
    shutil.copytree(run, again, symlinks=True)
    first, *_, last = sorted(again.glob("checkpoints/0*"))
    cronos_train(monkeypatch, "--resume=true", f"--config_path={first}/pretrained_model/train_config.json")
    assert len(starts(again)) == len(starts(run)) + 1
    same(run, again)
    return tuple(run / "checkpoints" / one.name / "pretrained_model" for one in (first, last))


def moved(first, last, file="model.safetensors"):
    """Names of the tensors that differ between two checkpoints."""
    before, after = load_file(first / file), load_file(last / file)
    return {name for name, tensor in after.items() if not torch.equal(tensor, before[name])}


def starts(folder):
    return json.loads((folder / "manifest.json").read_text())["starts"]


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


def test_a_run_that_is_told_to_stop_saves_and_resumes(tmp_path, monkeypatch):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    flags = (*SMALL, *OBSERVATIONS["pixels"])
    stopped = run_forked(
        [sys.executable, "-c", STOPPED, broken, *flags, f"--output_dir={broken}", "--steps=100000"]
    )
    assert stopped.returncode == -signal.SIGTERM, stopped.stderr
    steps = int((broken / "checkpoints/last").resolve().name)
    assert metrics(broken)[-1]["interaction_steps"] == steps < 100_000
    before = weights(broken)
    end = f"--steps={steps + 16}"
    cronos_train(monkeypatch, "--resume=true", f"--output_dir={broken}", end)
    cronos_train(monkeypatch, *flags, f"--output_dir={whole}", end)
    assert any(not torch.equal(before[name], tensor) for name, tensor in weights(broken).items())
    assert_same_weights(whole, broken)
    # Not given, PyTorch's own number of threads is on record, and a resumed run takes it from there.
    assert [start["config"]["torch_threads"] for start in starts(broken)] == [torch.get_num_threads()] * 2


def test_one_command_begins_a_run_resumes_it_and_then_does_nothing(tmp_path, monkeypatch):
    run, whole = tmp_path / "run", tmp_path / "whole"
    command = (*SMALL, *OBSERVATIONS["state"], "--resume=auto", f"--output_dir={run}")
    # Killed before its first checkpoint, it has left what is worth nothing.
    run.mkdir()
    (run / "metrics.jsonl").write_text('{"kind": "update"}\n')
    (run / "streams").mkdir()
    (run / "manifest.json").write_text(json.dumps({"starts": [{"machine": {}}]}))
    cronos_train(monkeypatch, *command, "--steps=16")
    assert (len(starts(run)), (run / "streams").exists()) == (1, False)
    for _ in range(2):
        # Fewer steps are done as well.
        cronos_train(monkeypatch, *command, "--steps=16")
        cronos_train(monkeypatch, *command, "--steps=8")
        assert (len(starts(run)), len(metrics(run))) == (1, 1)
    cronos_train(monkeypatch, *command, "--steps=32")
    assert [start["interaction_steps"] for start in starts(run)] == [0, 16]
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], f"--output_dir={whole}")
    assert_same_weights(whole, run)


def test_a_config_made_in_python_is_that_of_the_flags(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["cronos-train", "--steps=1000", "--resume=true", "--policy.path=/nowhere"])
    config = script.read_config([*SMALL, *OBSERVATIONS["state"], "--steps=16"])
    config.output_dir, config.resume = tmp_path / "run", "auto"
    for steps in (16, 32):
        config.steps, config.checkpoint_path = steps, None
        script.train(config)
    assert [line["interaction_steps"] for line in metrics(tmp_path / "run")] == [16, 32]


def test_a_run_of_a_gpu_resumes_on_a_cpu(tmp_path, monkeypatch, capsys):
    """Its generators of torch have a state that none of a CPU has: 16 bytes. Everything else is where it was."""
    run = tmp_path / "run"
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], "--steps=16", f"--output_dir={run}")
    last = run / "checkpoints/last"
    state = torch.load(last / "training_state/state.pt")
    assert state["generators"]["torch"]
    state["generators"]["torch"] = {name: [1] * 16 for name in state["generators"]["torch"]}
    state["config"]["policy"]["device"] = "cuda"
    for group in state["optimizer"]["param_groups"]:
        # PyTorch's choice on a GPU.
        group["fused"] = None
    torch.save(state, last / "training_state/state.pt")
    config = last / "pretrained_model/train_config.json"
    config.write_text(config.read_text().replace('"device": "cpu"', '"device": "cuda"'))
    before = weights(run)
    cronos_train(monkeypatch, "--resume=true", f"--config_path={config}", "--policy.device=cpu", "--steps=32")
    assert "This run began on cuda" in "".join(capsys.readouterr())
    assert [line["interaction_steps"] for line in metrics(run)] == [16, 32]
    assert any(not torch.equal(tensor, before[name]) for name, tensor in weights(run).items())
    # The moments went on, and its steps are computed as on a CPU.
    optimizer = read_state(last)["optimizer"]
    for index, values in optimizer["state"].items():
        assert values["step"] > state["optimizer"]["state"][index]["step"] > 0
    assert all(group["fused"] for group in optimizer["param_groups"])


def test_strategy_of_the_readme_and_order_of_the_docs(tmp_path):
    """Word for word, as a package of a user's."""
    root, package = Path(__file__).parents[2], tmp_path / "my_protocol"
    package.mkdir()
    code = []
    for page, pattern in (("README.md", "register_reset"), ("docs/extend.md", "register_task_order")):
        blocks = re.findall(r"```python\n(.*?)```", (root / page).read_text(), re.DOTALL)
        (block,) = (block for block in blocks if f"@{pattern}" in block)
        code.append(block)
    (package / "__init__.py").write_text("\n".join(code))
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    output = tmp_path / "run"
    command = [
        "cronos-train", *SMALL, *OBSERVATIONS["state"], "--protocol.discover_packages_path=my_protocol",
        "--protocol.extra_resets=[after_failures]", "--protocol.task_order=weaker_more_often",
        "--protocol.scene_reset_interval=null", "--protocol.heuristic_reset=true", f"--output_dir={output}",
        "--steps=48",
    ]  # fmt: skip
    run_forked(command, check=True, env=env)
    last = metrics(output)[-1]
    # Two streams of 24 steps: six segments, all failed, so that the fourth switch resets both.
    assert last["interventions_by_kind"]["scene_reset"] == 2
    assert last["interventions_by_stream"] == [last["interventions"] // 2] * 2
    assert last["interventions_by_kind"]["task_switch"] == 12


def test_what_cannot_be_is_one_line(tmp_path, monkeypatch):
    """A finished run, resumed or begun from in ways that do not fit it."""
    run = tmp_path / "run"
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], f"--output_dir={run}", "--steps=16")
    last = run / "checkpoints/last/pretrained_model"
    (start,) = starts(run)
    assert start["environment"] == "lerobot_env_cronos/kitchen_2x2-v1"
    # It began with a policy of its own, not with one in a folder.
    assert start["policy_fingerprint"] is None

    def refused(named, *arguments):
        with pytest.raises(SystemExit, match=named) as ended:
            cronos_train(monkeypatch, *arguments)
        assert str(ended.value).startswith("error: ")
        assert "\n" not in str(ended.value)

    resume = ("--resume=true", f"--config_path={last}/train_config.json", "--steps=32")
    refused("--env.scene=playroom_2x2", *resume, "--env.scene=playroom_2x2")
    with FolderLock(run):
        refused("run is being written by process", *resume)
    (run / "metrics.jsonl").write_bytes(b"")
    refused("metrics.jsonl has 0 bytes", *resume)
    assert len(starts(run)) == 1

    refused(f"{run} exists", *SMALL, *OBSERVATIONS["state"], f"--output_dir={run}")
    scratch = (
        "--env.type=cronos", "--env.observation_height=96", "--env.observation_width=96", "--num_envs=2",
        f"--output_dir={tmp_path / 'new'}", "--policy.device=cpu",
    )  # fmt: skip
    refused(
        "--algorithm.type=imitation", *scratch, "--policy.type=vqbet", "--policy.pretrained_backbone_weights=null"
    )
    begin = (*scratch, f"--policy.path={last}", *OBSERVATIONS["state"])
    refused("environment_state of 48 numbers", *begin, "--env.scene=kitchen_3x3")
    config = last / "config.json"
    text = config.read_text()
    config.write_text(text[:50])
    refused("config.json is damaged", *begin)
    config.write_text(text)
    (last / "model.safetensors").write_bytes(b"short")
    refused("model.safetensors", *begin)
    assert not (tmp_path / "new").exists()


def test_a_full_disk_is_one_line(tmp_path, monkeypatch):
    """No file may grow beyond the checkpoint's: writing fails as it does on a full disk."""
    run = tmp_path / "run"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(SystemExit) as ended:
            cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], f"--output_dir={run}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert str(ended.value).startswith("error: ")
    assert "\n" not in str(ended.value)
    assert not list(run.glob("checkpoints/*"))


class Alone(Ranks):
    """One process that says when it has left."""

    left = False

    def leave(self):
        self.left = True


def test_a_run_that_the_hub_refuses_says_what_pushes_it(tmp_path, monkeypatch):
    policy = DummyPolicyConfig(push_to_hub=True, repo_id="me/rl", private=True)
    trainer = SimpleNamespace(run=SimpleNamespace(ranks=Alone()), train=lambda stop: True)
    monkeypatch.setattr(script, "_prepare", lambda config, stack: trainer)

    def refused(error, ends):
        def publish(published):
            assert (published.repo_id, published.path, published.private) == ("me/rl", tmp_path, True)
            raise error

        monkeypatch.setattr(script, "publish_policy", publish)
        with pytest.raises(type(ends), match=str(ends)):
            script.train(CronosTrainConfig(CronosEnvConfig(), policy, tmp_path))
        assert trainer.run.ranks.left

    command = f"cronos-publish policy --path={tmp_path} --repo_id=me/rl --private=true"
    no_token = LocalTokenNotFoundError("Token is required,\nbut no token found.")
    for error in (no_token, OSError(28, "No space left on device")):
        refused(error, SystemExit(f"^error: .*`{command}`"))
    refused(ZeroDivisionError(), ZeroDivisionError())


def test_the_gpu_of_a_number_is_the_current_one(monkeypatch):
    """LeRobot keeps and restores the generator of the current one alone."""
    called = []
    monkeypatch.setattr(torch.cuda, "set_device", lambda device: called.append(str(device)))
    for device in ("cuda", "cpu", "mps", None, "cuda:1"):
        choose_gpu(device)
    assert called == ["cuda:1"]
