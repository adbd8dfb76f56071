"""The plugins in examples/ run, and do what they say."""

import json
import re
import shutil
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from forked_commands import run_forked
from lerobot_env_cronos import CronosVectorEnv
from safetensors.torch import load_file

from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.protocol import LoopState
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.factory import make_env, make_eval_env

EXAMPLES = Path(__file__).parents[2] / "examples"
TINY = (
    "--policy.type=pocketvla", "--policy.device=cpu", "--policy.hidden_width=16", "--policy.hidden_depth=1",
    "--env.obs_type=environment_state_agent_pos", "--env.num_threads=1", "--num_envs=2", "--seed=1",
    "--protocol.task_switch_interval=4", "--protocol.update_interval=8", "--eval_freq=0", "--tensorboard=false",
)  # fmt: skip


@pytest.fixture
def example(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    return import_module


def run(folder, *flags, tiny=TINY):
    """Run cronos-train as the docstrings say; returns the updates of metrics.jsonl."""
    command = (
        f"import sys; sys.path[:0] = {[str(EXAMPLES), str(EXAMPLES / 'lerobot_policy_mine')]!r};"
        "sys.argv = ['cronos-train', *sys.argv[1:]];"
        "from cronos_lerobot.scripts.train import main; main()"
    )
    own = () if "--resume=true" in flags else (*tiny, f"--output_dir={folder}")
    run_forked([sys.executable, "-c", command, *own, *flags], check=True)
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [record for record in records if record["kind"] == "update"]


def policy(folder, step="last"):
    """The weights of a checkpoint."""
    return load_file(folder / f"checkpoints/{step}/pretrained_model/model.safetensors")


def changed(before, after):
    """Names of the tensors that differ."""
    return {name for name, tensor in after.items() if not torch.equal(tensor, before[name])}


def test_an_order_by_values_and_resets_that_are_asked_for_run_together(tmp_path):
    updates = run(
        tmp_path / "run", "--env.type=cronos", "--steps=64", "--algorithm.minibatch_size=8",
        "--discover_packages_path=critic_order", "--protocol.discover_packages_path=asked_reset",
        "--protocol.task_order=critic", "--protocol.extra_resets=[asked]", "--protocol.reset_budget=4",
        "--protocol.scene_reset_interval=null",
    )  # fmt: skip
    # An untrained policy fails always. Two failures are known after 16 steps, when 1 of the 4 may be spent.
    assert [update["interventions_by_kind"]["scene_reset"] for update in updates] == [1, 2, 3, 3]


def test_help_is_executed_recorded_and_counted(tmp_path):
    updates = run(
        tmp_path / "run", "--env.discover_packages_path=scripted_help", "--env.type=cronos_helped", "--steps=64",
        "--algorithm.type=imitation", "--record.repo_id=me/helped", "--record.streams=all",
        "--protocol.scene_reset_interval=null",
    )  # fmt: skip
    # Both streams fail twice, the expert does a segment, the count begins anew: segments 2 and 5.
    assert [update["interventions_by_kind"]["help"] for update in updates] == [0, 2, 4, 4]
    (root,) = (path.parents[1] for path in (tmp_path / "run").rglob("meta/info.json"))
    streams = StreamDataset("me/helped", root)
    streams.check()
    assert [segment.helped for segment in streams.segments_of(0)] == [i in (2, 5) for i in range(8)]
    assert not {"cronos.log_prob", "cronos.value"} & set(streams.meta.features)


def test_nobody_helps_in_evaluations(example):
    env = example("scripted_help").HelpedEnvConfig(obs_type="environment_state_agent_pos")
    config = CronosTrainConfig(env=env)
    assert type(make_env(config, 1)).__name__ == "ScriptedHelp"
    assert type(make_eval_env(config, 1)) is CronosVectorEnv


def test_an_agent_learns_from_what_was_rewarded_and_resumes_bit_for_bit(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    # Every action is cloned: no task is complete so early.
    updates = run(
        whole, "--discover_packages_path=rewarded", "--algorithm.type=rewarded", "--algorithm.threshold=-9",
        "--env.type=cronos", "--steps=32", "--save_freq=16",
    )  # fmt: skip
    # Two streams, 8 steps an update.
    assert [update["agent"]["frames"] for update in updates] == [16, 16]
    shutil.copytree(whole, broken, symlinks=True)
    config = broken / "checkpoints/000016/pretrained_model/train_config.json"
    run(broken, "--discover_packages_path=rewarded", "--resume=true", f"--config_path={config}")
    assert not changed(policy(whole), policy(broken))
    assert changed(policy(whole, "000016"), policy(whole))


def test_a_policy_plugin_takes_updates_of_ppo(tmp_path):
    flags = [flag for flag in TINY if not flag.startswith("--policy.hidden")]
    flags[0] = "--policy.type=mine"
    run(
        tmp_path / "run", "--env.type=cronos", "--discover_packages_path=lerobot_policy_mine", "--steps=32",
        "--save_freq=16", "--algorithm.minibatch_size=8", "--algorithm.value_warmup_updates=0",
        "--algorithm.entropy_coef=0.1", tiny=flags,
    )  # fmt: skip
    # An untrained policy is never rewarded: its entropy and its values move.
    moved = changed(policy(tmp_path / "run", "000016"), policy(tmp_path / "run"))
    assert {name.split(".")[0] for name in moved} >= {"actor", "critic"}


def test_the_loop_by_itself_runs_as_the_docs_have_it(capsys):
    page = (EXAMPLES.parent / "docs/extend.md").read_text()
    exec(re.findall(r"```python\n(.*?)```", page, re.DOTALL)[-1], {})
    n, b, *_ = capsys.readouterr().out.splitlines()[-1].split(maxsplit=2)
    # 320 steps of 4 streams, and their scene reset.
    assert (n, b) == ("1280", "4")


def test_tasks_are_drawn_by_how_uncertain_their_values_are(example):
    weigh = example("critic_order").weigh
    # V = 0.4 is p = 0.5: (0.25 + 0.02) ** 2. Hopeless and certain ones have the floor alone.
    values = np.array([[0.4, -1.0, 2.0, 0.4]])
    complete = np.array([[False, False, False, True]])
    np.testing.assert_allclose(weigh(values, complete), [[0.0729, 0.0004, 0.0004, 0.0]])
    np.testing.assert_allclose(weigh(values[:, :1], np.array([[True]])), [[0.0729]])


def test_a_stream_is_stuck_after_two_failures_since_its_reset(example):
    loop = LoopState(4, num_tasks=2)
    loop.recent_success[:, -2:] = [[0, 0], [1, 0], [0, 0], [-1, 0]]
    loop.segments_since_reset[:] = [2, 2, 1, 1]
    assert example("asked_reset").find_stuck(loop).tolist() == [0]
