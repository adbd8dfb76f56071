"""`cronos-eval` and `lerobot-eval` on the real scenes with tiny policies, and the scripted expert."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from forked_commands import run_forked
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.scripts.lerobot_eval import eval_policy, rollout
from lerobot_env_cronos import CronosEnvConfig, IndependentVectorEnv, SequentialVectorEnv, get_scene
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark
from scripted_env import ScriptedEnv
from tiny_checkpoints import STATE, save_policy

from cronos_lerobot.agents.processing import make_processors
from cronos_lerobot.evaluation.actors import make_actor
from cronos_lerobot.evaluation.chains import Chain, ChainRunner, chain_noise
from cronos_lerobot.evaluation.config import CronosEvalConfig, SuitesConfig
from cronos_lerobot.evaluation.film import DRAWN
from cronos_lerobot.evaluation.outcomes import read_outcomes
from cronos_lerobot.evaluation.plan import Part
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.evaluation.store import RESULTS
from cronos_lerobot.scripts import eval as script

SMALL = ("--eval.n_episodes=2", "--eval.orderings=3", "--eval.splits=held_out", "--eval.batch_size=4")


@pytest.fixture(scope="module")
def pocketvla(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pocketvla")
    return save_policy(folder, "pocketvla", STATE, hidden_width=16, hidden_depth=1)


def cronos_eval(monkeypatch, *arguments) -> None:
    monkeypatch.setattr(sys, "argv", ["cronos-eval", *map(str, arguments)])
    script.main()


def outcomes(folder: Path) -> dict:
    return {path.name: json.loads(path.read_text())["chains"] for path in sorted(folder.glob("parts/*.json"))}


def test_everything_in_one_go_then_again_after_a_kill(pocketvla, tmp_path, monkeypatch, capsys):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    flags = (f"--policy.path={pocketvla}", *SMALL, "--env.render_size=[64, 64]")
    cronos_eval(monkeypatch, *flags, f"--output_dir={whole}")
    output = capsys.readouterr().out
    for text in ("put the ketchup bottle on the cloth", "SEQ 3", "chain length", "held_out (n=6)"):
        assert text in output
    results = json.loads((whole / RESULTS).read_text())
    assert {"format": 2, "scene": "kitchen_2x2", "obs_type": STATE["obs_type"], "temperature": 0.6}.items() <= (
        results.items()
    )
    assert results["independent"]["held_out"]["n"] == 4 * 2
    assert [p["n"] for p in results["sequential"]["held_out"]["positions"]] == [6] * 4
    assert len(results["sequential"]["held_out"]["per_ordering"]) == 3
    # Killed in the second part: what is finished is kept, the rest comes out as if nothing had happened.
    run_part, ran = Evaluation._run_part, []

    def killed(self, part, bar):
        if len(ran) == 1:
            raise KeyboardInterrupt
        ran.append(part.name)
        run_part(self, part, bar)

    monkeypatch.setattr(Evaluation, "_run_part", killed)
    with pytest.raises(SystemExit, match="goes on from here"):
        cronos_eval(monkeypatch, *flags, f"--output_dir={broken}")
    assert list(outcomes(broken)) == ["independent_held_out.json"]
    assert not (broken / RESULTS).exists()
    first = (broken / "parts/independent_held_out.json").stat().st_mtime_ns
    monkeypatch.setattr(Evaluation, "_run_part", run_part)
    cronos_eval(monkeypatch, *flags, f"--output_dir={broken}")
    assert (broken / "parts/independent_held_out.json").stat().st_mtime_ns == first
    assert outcomes(broken) == outcomes(whole)
    again = json.loads((broken / RESULTS).read_text())
    assert [again[suite] for suite in ("independent", "sequential")] == [
        results[suite] for suite in ("independent", "sequential")
    ]


def test_a_repetition_is_the_evaluation_with_the_next_seed(pocketvla, tmp_path, monkeypatch):
    flags = (f"--policy.path={pocketvla}", "--eval.n_episodes=2", "--eval.suites=independent")
    flags += ("--eval.splits=held_out", "--env.render_size=[64, 64]")
    noise, seeds = Part.noise, []

    def spy(part, seed):
        seeds.append((part.name, seed))
        return noise(part, seed)

    monkeypatch.setattr(Part, "noise", spy)
    cronos_eval(monkeypatch, *flags, f"--output_dir={tmp_path / 'both'}")
    filmed = json.loads((tmp_path / "both" / RESULTS).read_text())["videos"]
    # Asked for later: what is there is kept.
    first = (tmp_path / "both/parts/independent_held_out.json").stat().st_mtime_ns
    video = tmp_path / "both" / filmed[0]["path"]
    drawn = video.stat().st_mtime_ns
    cronos_eval(monkeypatch, *flags, "--eval.repetitions=2", f"--output_dir={tmp_path / 'both'}")
    assert (tmp_path / "both/parts/independent_held_out.json").stat().st_mtime_ns == first
    assert video.stat().st_mtime_ns == drawn
    cronos_eval(monkeypatch, *flags, "--eval.videos=0", "--seed=1001", f"--output_dir={tmp_path / 'next'}")
    both, after = outcomes(tmp_path / "both"), outcomes(tmp_path / "next")
    assert list(both) == ["independent_held_out.json", "independent_held_out_again1.json"]
    assert both["independent_held_out_again1.json"] == after["independent_held_out.json"]
    # A policy that never succeeds fails alike with every seed: what its actions were drawn from tells more.
    names = ("independent_held_out", "independent_held_out_again1", "independent_held_out")
    assert seeds == list(zip(names, (1000, 1001, 1001), strict=True))
    results = json.loads((tmp_path / "both" / RESULTS).read_text())
    assert (results["repetitions"], results["independent"]["held_out"]["n"]) == (2, 4 * 2 * 2)
    assert results["videos"] == filmed
    lengths = read_outcomes(tmp_path / "both").lengths
    assert {episode.seed for episode in lengths} == {1000, 1001}
    second = {episode: length for episode, length in lengths.items() if episode.seed == 1001}
    assert second == read_outcomes(tmp_path / "next").lengths
    assert len(lengths) == 16


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--eval.repetitions=0"], "eval.repetitions must be at least 1, got 0"),
        (["--eval.repetitions=2", "--eval.suites=sequential"], "eval.repetitions is of the independent suite"),
        (
            ["--eval.repetitions=2", "--eval.temperature=0"],
            "eval.repetitions=2 would all be alike with --eval.temp",
        ),
    ],
)
def test_repetitions_that_are_none_are_refused(flags, message, pocketvla, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=message):
        cronos_eval(monkeypatch, f"--policy.path={pocketvla}", *flags, f"--output_dir={tmp_path / 'out'}")


def test_an_output_folder_is_of_one_evaluation(pocketvla, tmp_path, monkeypatch):
    flags = (f"--policy.path={pocketvla}", "--eval.n_episodes=1", "--eval.suites=independent", "--eval.videos=0")
    flags += ("--eval.splits=train", f"--output_dir={tmp_path / 'out'}")
    cronos_eval(monkeypatch, *flags)
    with pytest.raises(SystemExit, match=r"temperature: 0.6 there, 1.0 now"):
        cronos_eval(monkeypatch, *flags, "--eval.temperature=1")


def test_the_expert_is_near_the_ceiling_and_its_chains_are_filmed(tmp_path, monkeypatch):
    folder = tmp_path / "expert"
    flags = ("--expert=true", "--eval.n_episodes=4", "--eval.orderings=2", "--eval.splits=train")
    cronos_eval(monkeypatch, *flags, "--env.render_size=[120, 160]", f"--output_dir={folder}")
    results = json.loads((folder / RESULTS).read_text())
    # 16 episodes and 8 chains; the expert fails about one task in fifty.
    assert results["independent"]["train"]["success"] >= 14 / 16
    assert results["sequential"]["train"]["positions"][3]["success"] >= 6 / 8
    assert results["sequential"]["train"]["average_chain_length"]["mean"] >= 3.4
    assert (results["policy"], results["temperature"]) == ("scripted expert", None)
    good = next(v for v in results["videos"] if (v["suite"], v["kind"]) == ("sequential", "good"))
    with av.open(str(folder / good["path"])) as video:
        frames = sum(1 for _ in video.decode(video=0))
        assert (video.streams.video[0].height, video.streams.video[0].width) == (120, 160)
    assert frames == good["steps"] + 1 + 30


ACT = {
    "chunk_size": 10, "n_action_steps": 10, "dim_model": 16, "n_heads": 2, "dim_feedforward": 32,
    "n_encoder_layers": 1, "n_decoder_layers": 1, "use_vae": False, "pretrained_backbone_weights": None,
}  # fmt: skip
"""The smallest ACT: it has no sample_actions, and queues chunks of actions for the whole batch."""


def test_a_lerobot_policy_with_action_chunks(tmp_path, monkeypatch):
    checkpoint = save_policy(tmp_path / "act", "act", STATE, **ACT)
    folder = tmp_path / "out"
    flags = (f"--policy.path={checkpoint}", "--eval.videos=0", *SMALL, f"--output_dir={folder}")
    cronos_eval(monkeypatch, *flags)
    results = json.loads((folder / RESULTS).read_text())
    assert results["temperature"] is None
    assert results["sequential"]["held_out"]["n"] == 6
    assert results["obs_type"] == STATE["obs_type"]
    # It draws nothing, and would do the same again: before the first time is there, and after.
    flags = (*flags[:2], *SMALL[::2], "--eval.suites=independent", f"--output_dir={folder / 'again'}")
    for repetitions in (3, 2):
        cronos_eval(monkeypatch, *flags, "--eval.batch_size=4", f"--eval.repetitions={repetitions}")
        results = json.loads((folder / "again" / RESULTS).read_text())
        assert (results["repetitions"], results["independent"]["held_out"]["n"]) == (1, 8)


def test_a_lerobot_policy_does_what_it_does_in_lerobot_eval(tmp_path):
    """The same observations, processors and resets: the same motion, step by step."""
    checkpoint = save_policy(tmp_path / "act", "act", STATE, **ACT)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    policy: Any = make_policy(config, env_cfg=CronosEnvConfig(**STATE))
    processors = make_pre_post_processors(config, str(checkpoint))
    tasks = get_scene("kitchen_2x2").tasks
    theirs = IndependentVectorEnv(3, task=tasks[1], **STATE)
    env_processors = CronosEnvConfig().get_env_processors()
    rollout(theirs, policy, *env_processors, *processors, seeds=[4, 5, 6])
    ours = SequentialVectorEnv(3, ordering=tasks, **STATE)
    chains = [Chain(1, (tasks[1],), configuration) for configuration in (4, 5, 6)]
    results = ChainRunner(ours, make_actor(policy, make_processors(policy, *processors), 0.6, env_processors)).run(
        chains, chain_noise(80, 0)
    )
    assert [result.steps for result in results] == [80] * 3
    np.testing.assert_array_equal(ours.simulation.qpos, theirs.simulation.qpos)
    start, end = results[0].trajectory.qpos[[0, -1]]
    assert np.abs(start[:6] - end[:6]).max() > 0.05  # it has moved


def test_observations_and_scene_follow_from_the_policy(tmp_path, monkeypatch):
    options = {"scene": "playroom_2x2", "observation_height": 64, "observation_width": 96}
    checkpoint = save_policy(tmp_path / "policy", "pocketvla", options, hidden_width=16, hidden_depth=1)
    # cronos-train leaves its config beside the weights.
    (checkpoint / "train_config.json").write_text(json.dumps({"env": {"scene": "playroom_2x2"}}))
    folder = tmp_path / "out"
    cronos_eval(
        monkeypatch, f"--policy.path={checkpoint}", "--eval.n_episodes=1", "--eval.splits=train",
        "--eval.suites=independent", "--eval.videos=0", f"--output_dir={folder}",
    )  # fmt: skip
    results = json.loads((folder / RESULTS).read_text())
    assert (results["scene"], results["obs_type"]) == ("playroom_2x2", "pixels_agent_pos")
    env = results["identity"]["env"]
    assert (env["observation_height"], env["observation_width"]) == (64, 96)
    assert not env["privileged_state"]
    instructions = [task.instruction for task in get_scene("playroom_2x2").tasks]
    assert list(results["independent"]["train"]["per_task"]) == instructions


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ((), "--policy.path"),
        (("--expert=true", "--env.suite=sequential"), "--eval.suites"),
        (("--expert=true", "--env.advance=window"), "--advance"),
        (("--expert=true", "--advance=never"), "'never'.*on_success"),
        (("--expert=true", "--eval.suites=independent,chains"), "independent,chains"),
        (("--expert=true", "--eval.splits=test"), "held_out.*'test'"),
        (("--expert=true", "--eval.n_episodes=65"), "1 to 64, got 65"),
        (("--expert=true", "--eval.orderings=50"), "eval.orderings must be 1 to 10, got 50"),
        (
            ("--expert=true", "--eval.suites=independent", "--eval.orderings=3"),
            "--eval.orderings=3 is of the sequential suite; --eval.suites=independent leaves it out",
        ),
        (("--expert=true", "--eval.suites=independent", "--advance=on_success"), "--advance=on_success is of"),
        (
            ("--expert=true", "--eval.suites=independent", "--end_effector_reset=true"),
            "--end_effector_reset=True is of the sequential suite",
        ),
        (("--expert=true", "--eval.batch_size=0"), "batch_size must be at least 1, got 0"),
        (("--expert=true", "--seed=-1"), "seed must be at least 0"),
        (("--expert=true", "--torch_threads=0"), "torch_threads must be at least 1, or null, got 0"),
        (("--expert=true", "--env.scene=garage"), "garage.*kitchen_2x2"),
        (("--policy.path=outputs/no/where",), "outputs/no/where is neither a folder nor"),
    ],
)
def test_command_line_errors_name_the_bad_value_and_the_valid_ones(flags, message, tmp_path, monkeypatch):
    with pytest.raises(SystemExit, match=message):
        cronos_eval(monkeypatch, *flags, f"--output_dir={tmp_path / 'out'}")


def test_help_teaches(monkeypatch, capsys):
    with pytest.raises(SystemExit) as end:
        cronos_eval(monkeypatch, "--help")
    assert end.value.code == 0
    output = capsys.readouterr().out
    for text in ("examples:", "--eval.suites", "--advance", "--quick", "on_success"):
        assert text in output


def test_suites_that_are_added_to_a_folder_leave_it_the_same_evaluation(tmp_path, monkeypatch):
    """Of a benchmark whose chains begin at fewer configurations than its tasks."""
    benchmark = draw_benchmark("kitchen_2x2", seed=1, num_configurations=4, num_orderings=2)
    chains = {
        split: tuple(replace(group, configurations=group.configurations[:2]) for group in groups)
        for split, groups in benchmark.sequential.items()
    }
    monkeypatch.setattr(CronosEvalConfig, "benchmark", lambda self: replace(benchmark, sequential=chains))
    both, one = (
        CronosEvalConfig(expert=True, eval=SuitesConfig(suites=suites))
        for suites in ("independent,sequential", "sequential")
    )
    assert one.num_configurations == both.num_configurations == 4
    assert one.identity() == both.identity()
    with pytest.raises(ValueError, match=r"n_episodes must be 1 to 2, got 3"):
        CronosEvalConfig(expert=True, eval=SuitesConfig(suites="sequential", n_episodes=3)).validate()


def test_quick_is_less():
    config, quick = CronosEvalConfig(), CronosEvalConfig(quick=True)
    assert (config.num_configurations, config.num_orderings) == (64, 10)
    assert (quick.num_configurations, quick.num_orderings) == (16, 3)


def test_lerobot_reads_the_chain_length_as_the_sum_of_rewards(pocketvla):
    """LeRobot's own evaluation of chains with known outcomes: its numbers are those of the suite."""
    config = PreTrainedConfig.from_pretrained(pocketvla)
    config.pretrained_path = pocketvla
    policy = make_policy(config, env_cfg=CronosEnvConfig(**STATE))
    never = 81
    env = ScriptedEnv([[5, 80, 1, 40], [5, never, 1, 1], [never, 1, 1, 1], [80, 80, 80, never]])
    preprocessor, postprocessor = make_pre_post_processors(config, str(pocketvla))
    before, after = CronosEnvConfig().get_env_processors()
    info = eval_policy(env, policy, before, after, preprocessor, postprocessor, n_episodes=4, start_seed=0)
    assert [episode["sum_reward"] for episode in info["per_episode"]] == [4, 1, 0, 3]
    assert [episode["success"] for episode in info["per_episode"]] == [True, False, False, False]
    assert info["aggregated"]["avg_sum_reward"] == 2.0


def test_lerobot_eval_command(pocketvla, tmp_path):
    command = ["lerobot-eval", f"--policy.path={pocketvla}", "--policy.device=cpu", "--env.type=cronos"]
    command += ["--env.suite=sequential", "--env.split=held_out", "--env.obs_type=environment_state_agent_pos"]
    command += ["--env.render_size=[32, 32]", "--eval.n_episodes=2", "--eval.batch_size=2"]
    command += [f"--output_dir={tmp_path / 'out'}"]
    one = run_forked([*command, "--env.task=3"])
    assert one.returncode == 0, one.stderr[-2000:]
    info = json.loads((tmp_path / "out/eval_info.json").read_text())
    (entry,) = info["per_task"]
    assert (entry["task_group"], entry["task_id"]) == ("sequential_held_out", 3)
    assert len(entry["metrics"]["sum_rewards"]) == 2
    assert set(entry["metrics"]["sum_rewards"]) <= {0, 1, 2, 3, 4}
    assert info["per_group"]["sequential_held_out"]["n_episodes"] == 2


def test_a_part_says_what_made_it_and_is_kept_made_again_or_refused_by_that(pocketvla, tmp_path, caplog):
    folder = tmp_path / "out"

    def evaluate(videos=0, size=(48, 64)):
        policy = PreTrainedConfig.from_pretrained(pocketvla)
        policy.pretrained_path, policy.device = pocketvla, "cpu"
        suites = SuitesConfig("independent", "train", n_episodes=1, batch_size=4, videos=videos)
        env = CronosEnvConfig(**STATE, render_size=size)
        return Evaluation(CronosEvalConfig(env, policy, suites, output_dir=folder)).run()

    def edit(**made_by):
        content = json.loads(path.read_text())
        content["made_by"] |= made_by
        path.write_text(json.dumps(content))
        return path.stat().st_mtime_ns

    first = evaluate()
    path = folder / "parts/independent_train.json"
    made_by = json.loads(path.read_text())["made_by"]
    assert made_by["environment"] == "lerobot_env_cronos/kitchen_2x2-v1"
    assert made_by["policy"] == first["policy_fingerprint"] == first["identity"]["policy"]
    assert first["made_by"] == [made_by | {"parts": ["independent_train"]}]
    assert first["commit"] == made_by["commit"]
    # Another commit made it: kept, and named.
    before = edit(commit="a" * 40)
    again = evaluate()
    assert path.stat().st_mtime_ns == before
    assert (again["commit"], again["made_by"][0]["commit"]) == ("a" * 40, "a" * 40)
    # Another package: made again, with a word.
    edit(versions=made_by["versions"] | {"mujoco": "1.0"})
    assert evaluate()["made_by"] == first["made_by"]
    assert "mujoco 1.0, now" in caplog.text
    # It has no states to draw videos from: run again, to the same outcome.
    filmed = evaluate(videos=2)
    assert filmed["independent"] == first["independent"]
    assert len(filmed["videos"]) == 2
    before = path.stat().st_mtime_ns
    # More videos than the first time, without running anything.
    assert len(evaluate(videos=4)["videos"]) == 4
    # Of another size: drawn anew, also where nothing but results.json says of which size the old ones are.
    for size, is_noted in (((64, 64), True), ((48, 64), False)):
        if not is_noted:
            (folder / DRAWN).unlink()
        (video,) = evaluate(videos=1, size=size)["videos"]
        with av.open(str(folder / video["path"])) as film:
            assert (film.streams.video[0].height, film.streams.video[0].width) == size
    assert path.stat().st_mtime_ns == before
    edit(policy="another")
    with pytest.raises(ValueError, match=r"another policy: another there, .*now; choose another --output_dir"):
        evaluate()
    content = json.loads(path.read_text())
    path.write_text(json.dumps({name: content[name] for name in ("suite", "split", "date", "seconds", "chains")}))
    with pytest.raises(ValueError, match=r"part independent_train .* does not say which version"):
        evaluate()


@pytest.mark.parametrize(
    ("flag", "message"),
    [
        ("--env.obs_type=pixels_agent_pos", "environment_state.*--env.obs_type=environment_state_agent_pos"),
        ("--env.scene=kitchen_3x3", "of 48 numbers, kitchen_3x3 gives 72.*--env.scene=kitchen_2x2"),
        ("--policy.foo=1", "^error: --policy.path=.*: unrecognized arguments: --policy.foo=1$"),
        (
            "--env.render_size=[241,320]",
            "render_size are 241 and 320: a video's height and width must be even",
        ),
    ],
)
def test_an_environment_that_does_not_fit_the_policy_is_refused_with_the_flag_that_would(
    flag, message, pocketvla, tmp_path, monkeypatch
):
    with pytest.raises(SystemExit, match=message):
        cronos_eval(monkeypatch, f"--policy.path={pocketvla}", flag, f"--output_dir={tmp_path / 'out'}")
