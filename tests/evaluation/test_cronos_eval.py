"""`cronos-eval` and `lerobot-eval` on the real scenes with tiny policies, and the scripted expert."""

import json
import sys
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from forked_commands import run_forked
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import rollout
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv, IndependentVectorEnv, get_scene, load_benchmark
from PIL import Image
from tiny_checkpoints import STATE, TINY_ACT, save_policy

from cronos_lerobot.agents.processing import make_processors
from cronos_lerobot.evaluation.actors import make_actor
from cronos_lerobot.evaluation.chains import Chain, ChainRunner
from cronos_lerobot.evaluation.config import CronosEvalConfig
from cronos_lerobot.evaluation.results import find_videos, read_results
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.scripts import eval as script

SMALL = ("--eval.n_episodes=2", "--eval.orderings=3", "--eval.splits=[held_out]", "--eval.batch_size=4")


@pytest.fixture(scope="module")
def pocketvla(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pocketvla")
    return save_policy(folder, "pocketvla", STATE, hidden_width=16, hidden_depth=1)


def cronos_eval(monkeypatch, *arguments) -> None:
    monkeypatch.setattr(sys, "argv", ["cronos-eval", *map(str, arguments)])
    script.main()


def read(folder: Path, name: str) -> dict:
    return read_results(folder / name / "results.json")


def test_everything_in_one_go_and_after_a_kill_what_is_missing(pocketvla, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "out"
    flags = (f"--policy.path={pocketvla}", *SMALL, "--env.render_size=[64, 64]", f"--output_dir={folder}")
    run_suite, ran = Evaluation._run_suite, []

    def killed(self, env, actor, suite, split):
        ran.append(suite)
        if ran == ["independent", "sequential"]:
            raise KeyboardInterrupt
        return run_suite(self, env, actor, suite, split)

    monkeypatch.setattr(Evaluation, "_run_suite", killed)
    with pytest.raises(SystemExit, match="--output_dir"):
        cronos_eval(monkeypatch, *flags)
    assert [path.parent.name for path in folder.rglob("results.json")] == ["independent_held_out"]
    first = (folder / "independent_held_out/results.json").stat().st_mtime_ns
    cronos_eval(monkeypatch, *flags)
    assert (folder / "independent_held_out/results.json").stat().st_mtime_ns == first
    assert ran == ["independent", "sequential", "sequential"]
    output = capsys.readouterr().out
    for text in ("put the ketchup bottle on the cloth", "SEQ 3", "chain length", "held_out"):
        assert text in output
    independent, sequential = read(folder, "independent_held_out"), read(folder, "sequential_held_out")
    known = {"policy": str(pocketvla), "scene": "kitchen_2x2", "obs_type": STATE["obs_type"], "temperature": 0.6}
    known |= {"suite": "independent", "split": "held_out", "seed": 1000, "n": 8, "total": 256}
    assert known.items() <= independent.items()
    assert {(e["number"], e["configuration"]) for e in independent["episodes"]} == {
        (task, c) for task in range(4) for c in range(2)
    }
    assert (sequential["n"], len(sequential["per_ordering"])) == (6, 3)
    assert sequential["policy_fingerprint"] == independent["policy_fingerprint"]
    info = json.loads((folder / "eval_info.json").read_text())
    assert info["overall"]["n_episodes"] == 8 + 6
    # All done: nothing is run again, whatever else is asked of it is another evaluation.
    ran.clear()
    cronos_eval(monkeypatch, *flags)
    assert not ran
    with pytest.raises(SystemExit, match=r"error: .*temperature: 0.6 there, 1.0 now.*--output_dir"):
        cronos_eval(monkeypatch, *flags, "--eval.temperature=1")
    # Also beside suites that were not asked for.
    with pytest.raises(SystemExit, match=r"error: .*policy_fingerprint: .*--output_dir"):
        cronos_eval(monkeypatch, "--expert=true", *flags[1:], "--eval.suites=[stream]")
    assert not ran


def test_the_expert_is_near_the_ceiling_in_every_suite(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "expert"
    flags = ("--expert=true", "--eval.n_episodes=4", "--eval.orderings=2", "--eval.splits=[train]")
    flags += ("--eval.suites=[independent, sequential, stream]", "--env.render_size=[120, 160]")
    cronos_eval(monkeypatch, *flags, f"--output_dir={folder}")
    independent, sequential = read(folder, "independent_train"), read(folder, "sequential_train")
    # 16 episodes and 8 chains; the expert fails about one task in fifty.
    assert independent["success"] >= 14 / 16
    assert sequential["positions"][3]["success"] >= 6 / 8
    assert (independent["policy"], independent["temperature"]) == ("scripted expert", None)
    (good,) = [path for path in find_videos(folder / "sequential_train/results.json") if "good" in path.name]
    longest = max(sequential["episodes"], key=lambda e: (e["length"], -e["configuration"], -e["number"]))
    assert good.name == f"good_ordering{longest['number']}_configuration{longest['configuration']}.mp4"
    with av.open(str(good)) as video:
        frames = sum(1 for _ in video.decode(video=0))
        assert (video.streams.video[0].height, video.streams.video[0].width) == (120, 160)
    assert frames == longest["steps"] + 1 + 30
    stream = read(folder, "stream_train")
    assert (stream["n"], stream["segments"], {e["steps"] for e in stream["episodes"]}) == (4, 16, {16 * 80})
    assert stream["done"]["success"] > 0.9
    assert stream["by_segment"][0]["starts"]["free"] == 4
    output = capsys.readouterr().out
    for text in ("Stream: tasks in a row, nobody resets", "on other receptacle"):
        assert text in output
    with Image.open(folder / "stream_train/stuck.png") as picture:
        assert picture.size == (4 * 326 + 6, 4 * 246 + 6)


def test_a_lerobot_policy_does_what_it_does_in_lerobot_eval(tmp_path):
    """The same observations, processors and resets: the same motion, step by step."""
    checkpoint = save_policy(tmp_path / "act", "act", STATE, **TINY_ACT)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    policy: Any = make_policy(config, env_cfg=CronosEnvConfig(**STATE))
    processors = make_pre_post_processors(config, str(checkpoint))
    tasks = get_scene("kitchen_2x2").tasks
    theirs = IndependentVectorEnv(3, task=tasks[1], **STATE)
    env_processors = CronosEnvConfig().get_env_processors()
    rollout(theirs, policy, *env_processors, *processors, seeds=[4, 5, 6])
    ours = CronosVectorEnv(3, **STATE)
    chains = [Chain(1, (tasks[1],), configuration) for configuration in (4, 5, 6)]
    actor = make_actor(policy, make_processors(policy, *processors), 0.6, 7, env_processors)
    results = ChainRunner(ours, actor, states=ours.positions).run(chains, "train", (0,))
    assert [result.steps for result in results] == [80] * 3
    np.testing.assert_array_equal(ours.simulation.qpos, theirs.simulation.qpos)
    start, end = results[0].trajectory.states[[0, -1]]
    assert np.abs(start[:6] - end[:6]).max() > 0.05  # it has moved


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        ((), "--policy.path"),
        (("--expert=true", "--env.suite=sequential"), "--eval.suites"),
        (("--expert=true", "--advance=never"), "--advance"),
        (("--expert=true", "--eval.splits=[]"), "--eval.splits"),
        (("--expert=true", "--eval.n_episodes=0"), "--eval.n_episodes"),
        (("--expert=true", "--env.scene=garage"), "garage"),
        (("--policy.path=outputs/no/where",), "outputs/no/where"),
    ],
)
def test_a_wrong_flag_is_named(flags, named, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=f"error: .*{named}"):
        cronos_eval(monkeypatch, *flags, f"--output_dir={tmp_path / 'out'}")


@pytest.mark.parametrize(
    ("flag", "named"),
    [
        ("--env.obs_type=pixels_agent_pos", "--env.obs_type=environment_state_agent_pos"),
        ("--env.scene=kitchen_3x3", "--env.scene=kitchen_2x2"),
        ("--policy.foo=1", "--policy.foo"),
        ("--env.render_size=[241,320]", "--env.render_size"),
    ],
)
def test_an_environment_that_does_not_fit_the_policy_is_an_error(flag, named, pocketvla, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=f"error: .*{named}"):
        cronos_eval(monkeypatch, f"--policy.path={pocketvla}", flag, f"--output_dir={tmp_path / 'out'}")


def test_an_evaluation_of_lerobot_eval_is_not_overwritten(tmp_path, monkeypatch):
    (tmp_path / "eval_info.json").write_text("{}")
    with pytest.raises(SystemExit, match="--output_dir"):
        cronos_eval(monkeypatch, "--expert=true", f"--output_dir={tmp_path}")


@pytest.mark.parametrize("name", ["model.safetensors", "policy_preprocessor.json"])
def test_a_damaged_policy_is_told_in_one_line_and_takes_no_folder(name, tmp_path, monkeypatch):
    broken = save_policy(tmp_path / "policy", "pocketvla", STATE, hidden_width=16, hidden_depth=1)
    whole = (broken / name).read_bytes()
    (broken / name).write_bytes(whole[: len(whole) // 2])
    flags = ("--eval.n_episodes=1", "--eval.suites=[independent]", "--eval.splits=[train]", "--eval.videos=0")
    with pytest.raises(SystemExit, match=rf"^error: .*{broken}.* is damaged: "):
        cronos_eval(monkeypatch, f"--policy.path={broken}", *flags, f"--output_dir={tmp_path / 'out'}")
    (broken / name).write_bytes(whole)
    cronos_eval(monkeypatch, f"--policy.path={broken}", *flags, f"--output_dir={tmp_path / 'out'}")
    assert read(tmp_path / "out", "independent_train")["n"] == 4


def test_quick_is_less():
    whole, quick = CronosEvalConfig(expert=True), CronosEvalConfig(expert=True, quick=True)
    benchmark = load_benchmark(None, "kitchen_2x2")
    counts = [
        [len(c.chains(benchmark, suite, "train")) for suite in ("independent", "sequential", "stream")]
        for c in (whole, quick)
    ]
    assert counts == [[256, 640, 64], [4 * 16, 3 * 16, 16]]


def test_lerobot_eval_command(pocketvla, tmp_path):
    command = ["lerobot-eval", f"--policy.path={pocketvla}", "--policy.device=cpu", "--env.type=cronos"]
    command += ["--env.suite=sequential", "--env.split=held_out", "--env.obs_type=environment_state_agent_pos"]
    command += ["--env.render_size=[32, 32]", "--eval.n_episodes=2", "--eval.batch_size=2", "--env.task=3"]
    one = run_forked([*command, f"--output_dir={tmp_path / 'out'}"])
    assert one.returncode == 0, one.stderr[-2000:]
    info = json.loads((tmp_path / "out/eval_info.json").read_text())
    (entry,) = info["per_task"]
    assert entry["task_group"].endswith("sequential_held_out")
    assert entry["task_id"] == 3
    assert set(entry["metrics"]["sum_rewards"]) <= {0, 1, 2, 3, 4}
    wrong = run_forked(["lerobot-eval", f"--policy.path={pocketvla}", "--env.type=cronos", "--env.task=foo"])
    line = wrong.stderr.splitlines()[-1]
    assert (wrong.returncode, "Traceback" in wrong.stderr) == (1, False)
    assert line.startswith("error: ")
    assert all(text in line for text in ("'foo'", *(task.instruction for task in get_scene("kitchen_2x2").tasks)))
