"""`cronos-eval --compare_with --stop_at_error`: the scripted expert against made-up evaluations."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from synthetic_evaluations import write_evaluation

from cronos_lerobot.evaluation import stopping
from cronos_lerobot.evaluation.config import CronosEvalConfig, SuitesConfig
from cronos_lerobot.evaluation.outcomes import read_outcomes
from cronos_lerobot.evaluation.runner import Evaluation
from cronos_lerobot.evaluation.stopping import StoppingEvaluation
from cronos_lerobot.scripts import eval as script

FLAGS = ("--expert=true", "--eval.suites=independent", "--eval.splits=train", "--eval.videos=0")


def cronos_eval(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-eval", *FLAGS, *map(str, arguments)])
    script.main()


def test_it_stops_once_it_is_decided(tmp_path, monkeypatch, capsys):
    """Against a policy that always fails, the expert needs the 32 episodes of the first look, of 256."""
    reference = write_evaluation(tmp_path / "a", "me/zero", tasks=["0" * 64] * 4, split="train")
    folder = tmp_path / "out"
    cronos_eval(monkeypatch, f"--compare_with={reference}", "--stop_at_error=0.05", f"--output_dir={folder}")
    output = capsys.readouterr().out
    assert "independent train: better than me/zero, after 32 of 256 episodes at an error of 0.05" in output
    assert "by how much takes the whole evaluation" in output
    (test,) = json.loads((folder / "comparison.json").read_text())["tests"]
    assert (test["decision"], test["episodes"], test["planned"]) == ("better", 32, 256)
    assert (test["reference"], test["reference_ahead"]) == (0, 0)
    assert test["policy_ahead"] == 32 * test["policy"] > 28
    assert test["error_spent"] <= 0.05 * 32 / 256
    # The episodes come in a random order: all tasks are among them.
    (part,) = folder.glob("parts/*.json")
    chains = json.loads(part.read_text())["chains"]
    assert {chain["number"] for chain in chains} == {0, 1, 2, 3}
    assert len({(chain["number"], chain["configuration"]) for chain in chains}) == 32
    # Nothing takes it for an evaluation.
    assert not (folder / "results.json").exists()
    with pytest.raises(ValueError, match="was stopped as soon as a decision was made"):
        read_outcomes(folder)
    with pytest.raises(SystemExit, match=r"holds another evaluation .*stop_at_error: 0.05 there, 0.1 now"):
        cronos_eval(monkeypatch, f"--compare_with={reference}", "--stop_at_error=0.1", f"--output_dir={folder}")


def test_it_goes_on_after_a_kill_and_says_if_it_cannot_tell(tmp_path, monkeypatch, capsys):
    """Against a policy that always succeeds, on 8 episodes, 4 at a time."""
    reference = write_evaluation(tmp_path / "a", "me/one", tasks=["11"] * 4, split="train")
    monkeypatch.setattr(stopping, "LOOK_EVERY", 4)
    flags = (f"--compare_with={reference}", "--stop_at_error=0.05", f"--output_dir={tmp_path / 'out'}")
    run_part, ran = Evaluation._run_part, []

    def killed(self, part, bar):
        if ran:
            raise KeyboardInterrupt
        ran.append(part.name)
        run_part(self, part, bar)

    monkeypatch.setattr(Evaluation, "_run_part", killed)
    with pytest.raises(SystemExit, match="goes on from here"):
        cronos_eval(monkeypatch, *flags)
    monkeypatch.setattr(Evaluation, "_run_part", run_part)
    (first,) = (tmp_path / "out").glob("parts/*.json")
    made = first.stat().st_mtime_ns
    cronos_eval(monkeypatch, *flags)
    assert first.stat().st_mtime_ns == made
    assert "not separated from me/one, after 8 of 8 episodes" in capsys.readouterr().out
    done = [json.loads(path.read_text())["chains"] for path in (tmp_path / "out").glob("parts/*.json")]
    assert sorted((c["number"], c["configuration"]) for chains in done for c in chains) == [
        (number, configuration) for number in range(4) for configuration in range(2)
    ]


class Recorder:
    """Does nothing, and tells what it is seeded with."""

    is_per_environment, temperature, drew = True, None, False

    def __init__(self):
        self.seeds = []

    def seed(self, seed):
        self.seeds.append(seed)

    def begin(self, ids):
        pass

    def act(self, observation, instructions, uniform, ids):
        return np.zeros((len(ids), 7))


def test_no_two_blocks_draw_the_same_numbers(tmp_path, monkeypatch):
    reference = write_evaluation(tmp_path / "a", "me/zero", tasks=["000"] * 4, split="train")
    monkeypatch.setattr(stopping, "LOOK_EVERY", 4)
    suites = SuitesConfig("independent", "train", n_episodes=3, videos=0)
    seeds = []
    for seed in (1000, 1001):
        config = CronosEvalConfig(
            expert=True, eval=suites, seed=seed, compare_with=reference, stop_at_error=0.05,
            output_dir=tmp_path / str(seed),
        )  # fmt: skip
        config.validate()
        outcomes, actor = read_outcomes(reference), Recorder()
        lengths = {episode._replace(seed=seed): length for episode, length in outcomes.lengths.items()}
        StoppingEvaluation(config, replace(outcomes, lengths=lengths), lambda env, actor=actor: actor).run()
        seeds.append(actor.seeds)
    # The first block, which may be the only one, has that of the evaluation.
    assert [some[0] for some in seeds] == [1000, 1001]
    assert len({*seeds[0], *seeds[1]}) == 6


def test_without_an_error_everything_is_evaluated_and_compared(tmp_path, monkeypatch, capsys):
    reference = write_evaluation(tmp_path / "a", "me/zero", tasks=["00"] * 4, split="train")
    flags = (f"--compare_with={reference}", "--eval.n_episodes=2", f"--output_dir={tmp_path / 'out'}")
    cronos_eval(monkeypatch, *flags)
    output = capsys.readouterr().out
    assert "independent train: 8 pairs of episodes from 2 configurations" in output
    assert "A: me/zero" in output
    assert "B: scripted expert" in output
    # Two configurations can do no better than 2 of 4 ways to sign them.
    assert "Not separated, of these policies (p = 0.5)" in output


@pytest.mark.parametrize(
    ("flags", "sentence"),
    [
        (["--stop_at_error=0.05"], "--stop_at_error needs another policy's evaluation: --compare_with"),
        (
            ["--stop_at_error=0.05", "--compare_with={}", "--eval.videos=3"],
            "--stop_at_error films nothing: leave --eval.videos=3 out",
        ),
        (
            ["--stop_at_error=0.05", "--compare_with={}", "--eval.videos=1"],
            "--stop_at_error films nothing: leave --eval.videos=1 out",
        ),
        (["--stop_at_error=5", "--compare_with={}"], "stop_at_error must be between 0 and 1, got 5"),
        (["--compare_with={}/nothing"], "no results.json of cronos-eval at .*nothing"),
        (["--compare_with={}", "--seed=7"], r"has other seeds: \[1000\] and \[7\]"),
        (["--compare_with={}", "--env.scene=playroom_2x2"], "they differ in scene: kitchen_2x2 and playroom_2x2"),
        (["--compare_with={}", "--eval.splits=held_out"], "no task or ordering from any configuration is in both"),
    ],
)
def test_what_cannot_be_compared_is_refused_before_anything_runs(tmp_path, monkeypatch, flags, sentence):
    reference = write_evaluation(tmp_path / "a", "me/zero", tasks=["00"] * 4, split="train")
    with pytest.raises(SystemExit, match=sentence):
        cronos_eval(monkeypatch, *(flag.format(reference) for flag in flags), f"--output_dir={tmp_path / 'out'}")
    assert not (tmp_path / "out").exists()
