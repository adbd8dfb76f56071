"""The tasks that `lerobot-eval` numbers are those of the benchmark and scene that it ran."""

import json
import re
from dataclasses import replace
from types import MappingProxyType

import numpy as np
import pytest
from lerobot_env_cronos import load_benchmark
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark
from lerobot_env_cronos.benchmark.files import write_benchmark
from lerobot_env_cronos.scene.scenes import SCENES
from synthetic_runs import INSTRUCTIONS, write_evaluation, write_training_run

from cronos_lerobot.evaluation.rates import cluster_interval
from cronos_lerobot.report.runs import find_runs
from cronos_lerobot.scripts.report import make_report


def tasks_of(report):
    (compared,) = [one for one in report.comparisons if one.label == "lerobot-eval"]
    return list(compared.tasks)


@pytest.fixture
def evaluations(tmp_path):
    before = write_evaluation(tmp_path / "before", successes=(1, 2, 3, 4))
    return {"before": [before], "after": [write_evaluation(tmp_path / "after", successes=(2, 3, 4, 5))]}


def test_tasks_are_named_as_in_the_benchmark(evaluations, tmp_path):
    package = load_benchmark(None, "playroom_2x2")
    turned = {
        split: tuple(
            replace(group, number=i) for i, group in enumerate(package.groups("independent", split)[::-1])
        )
        for split in package.configurations
    }
    write_benchmark(replace(package, independent=MappingProxyType(turned)), tmp_path / "mine")
    report = make_report([], **evaluations, benchmark=str(tmp_path / "mine"))
    assert tasks_of(report) == [task.instruction for task in SCENES["playroom_2x2"].tasks][::-1]
    with pytest.raises(ValueError, match="is of playroom_2x2, not of kitchen_2x2"):
        make_report([], **evaluations, benchmark=str(tmp_path / "mine"), scene="kitchen_2x2")


def test_chains_go_together_by_the_configurations_that_their_own_ordering_begins_with(tmp_path):
    drawn = draw_benchmark("kitchen_2x2", seed=1, num_configurations=16, num_orderings=2)
    some = (tuple(range(8)), tuple(range(4, 16)))
    chains = {
        split: tuple(replace(g, configurations=own) for g, own in zip(groups, some, strict=True))
        for split, groups in drawn.sequential.items()
    }
    write_benchmark(replace(drawn, sequential=MappingProxyType(chains)), tmp_path / "mine")
    folder = write_evaluation(tmp_path / "eval", "sequential_train", successes=(13, 9), n=32)
    flags = np.random.default_rng(0).random((2, 32)) < 0.5
    info = json.loads((folder / "eval_info.json").read_text())
    for entry, own in zip(info["per_task"], flags.tolist(), strict=True):
        entry["metrics"]["successes"] = own
    (folder / "eval_info.json").write_text(json.dumps(info))
    (run,) = make_report([folder], benchmark=str(tmp_path / "mine")).evaluations
    first = run.tasks["ordering 0"].interval
    assert first == pytest.approx(cluster_interval(flags[0], np.arange(32) % 8))
    assert first != pytest.approx(cluster_interval(flags[0], np.arange(32) % 16))
    # lerobot-eval's episode i starts from number (1000 + i) % k of each ordering's own.
    starts = [own[(1000 + i) % len(own)] for own in some for i in range(32)]
    assert run.overall.interval == pytest.approx(cluster_interval(flags.ravel(), np.array(starts)))


def test_the_scene_is_that_of_the_runs_beside_them_unless_it_is_named(evaluations, tmp_path):
    assert tasks_of(make_report([], **evaluations)) == list(INSTRUCTIONS)
    run = write_training_run(tmp_path / "run")
    manifest = json.loads((run / "manifest.json").read_text())
    manifest["starts"][0]["config"]["env"] = {"scene": "playroom_2x2"}
    (run / "manifest.json").write_text(json.dumps(manifest))
    playroom = [task.instruction for task in SCENES["playroom_2x2"].tasks]
    assert tasks_of(make_report([run], **evaluations)) == playroom
    assert tasks_of(make_report([run], **evaluations, scene="kitchen_2x2")) == list(INSTRUCTIONS)
    with pytest.raises(ValueError, match="unknown scene 'nowhere'"):
        make_report([run], scene="nowhere")


@pytest.mark.parametrize("group", ["pusht", "libero_spatial", "independently_train"])
def test_an_evaluation_of_another_environment_is_said_to_be_one(tmp_path, group):
    write_evaluation(tmp_path / "cronos")
    other = write_evaluation(tmp_path / "other", group)
    said = (
        f"{other / 'eval_info.json'} is of another environment: its task group is '{group}', those of CRONOS begin"
        " with independent or sequential"
    )
    found = find_runs([tmp_path])
    assert found.left_out == [said]
    assert [run.name for run in found.evaluations] == ["cronos"]
    with pytest.raises(ValueError, match=re.escape(said)):
        find_runs([other])
