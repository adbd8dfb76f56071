"""`cronos-train` on the real scene with the real policy, far too short to learn anything."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_env_cronos import CronosEnvConfig
from safetensors.torch import load_file

from cronos_lerobot.scripts import train as script

SMALL = (
    "--policy.type=pocketvla", "--policy.device=cpu", "--policy.hidden_width=16", "--policy.hidden_depth=1",
    "--env.type=cronos", "--num_envs=2", "--protocol.task_switch_interval=4", "--protocol.update_interval=8",
    "--protocol.scene_reset_interval=8", "--steps=32", "--save_freq=16", "--eval_freq=0", "--tensorboard=false",
    "--algorithm.minibatch_size=8", "--algorithm.value_warmup_updates=0", "--algorithm.entropy_coef=0.1",
)  # fmt: skip
OBSERVATIONS = {
    "state": ("--env.obs_type=environment_state_agent_pos",),
    "pixels": ("--env.observation_height=64", "--env.observation_width=64"),
}


def cronos_train(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-train", *map(str, arguments)])
    script.main()


def weights(folder):
    return load_file(folder / "checkpoints/last/pretrained_model/model.safetensors")


@pytest.mark.parametrize("observation", OBSERVATIONS)
def test_train_kill_resume(observation, tmp_path, monkeypatch):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS[observation], f"--output_dir={whole}")
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS[observation], f"--output_dir={broken}", "--steps=16")
    last = broken / "checkpoints/last/pretrained_model"
    cronos_train(monkeypatch, "--resume=true", f"--config_path={last}/train_config.json", "--steps=32")
    before, after = load_file(broken / "checkpoints/000016/pretrained_model/model.safetensors"), weights(broken)
    assert any(not torch.equal(before[name], after[name]) for name in before)
    for name, tensor in weights(whole).items():
        assert torch.equal(tensor, after[name]), name
    # Not given, PyTorch's own number of threads is on record, and a resumed run takes it from there.
    starts = json.loads((broken / "manifest.json").read_text())["starts"]
    assert [start["config"]["torch_threads"] for start in starts] == [torch.get_num_threads()] * 2


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
        "--protocol.extra_resets=[stuck]", "--protocol.task_order=weakest_first",
        "--protocol.scene_reset_interval=null", "--protocol.heuristic_reset=true", f"--output_dir={output}",
        "--steps=48",
    ]  # fmt: skip
    script = str(Path(sys.executable).with_name(command[0]))
    subprocess.run([script, *command[1:]], check=True, env=os.environ | {"PYTHONPATH": str(tmp_path)})
    last = json.loads((output / "metrics.jsonl").read_text().splitlines()[-1])
    # Two streams of 24 steps: six segments, all failed, so that the fourth switch resets both.
    assert last["interventions_by_kind"]["scene_reset"] == 2
    assert last["interventions_by_stream"] == [last["interventions"] // 2] * 2
    assert last["interventions_by_kind"]["task_switch"] == 12


def test_policy_of_another_kind_is_refused(tmp_path, monkeypatch):
    with pytest.raises(TypeError, match="sample_actions"):
        cronos_train(
            monkeypatch, "--policy.type=act", "--policy.device=cpu", "--policy.pretrained_backbone_weights=null",
            "--env.type=cronos", "--num_envs=2", f"--output_dir={tmp_path / 'run'}",
        )  # fmt: skip
