"""Entries of `.eval_results/cronos.yaml`, from numbers that are known, and whose results they may be."""

import json

import pytest
import yaml
from hub_repositories import Repository
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark
from lerobot_env_cronos.benchmark.files import write_benchmark
from synthetic_evaluations import write_evaluation

from cronos_lerobot.evaluation.results import independent_results, read_evaluation, sequential_results
from cronos_lerobot.hub.benchmark import choose_benchmark
from cronos_lerobot.hub.config import BenchmarkConfig, ResultsConfig
from cronos_lerobot.hub.push import PublishError, push_folder
from cronos_lerobot.hub.results import FILE, changes_of_policy, make_entries, read_own_results
from cronos_lerobot.scripts.publish import publish_results

BENCHMARK = draw_benchmark("kitchen_2x2", seed=0, num_configurations=2, num_orderings=2, chain_length=2)
POLICY, REPOSITORY = "me/at_once", "me/bench_at_once"
SEEN = {"observation": {"task_observation": "none"}, "reads_privileged_state": False}
COMMON = SEEN | {
    "temperature": 0.6, "seed": 3, "advance": "window", "end_effector_reset": False, "date": "2026-11-21",
    "obs_type": "pixels_agent_pos", "renderer": "classic", "split": "train",
    "versions": {"cronos-lerobot": "0.1.0", "lerobot_env_cronos": "0.1.0"},
}  # fmt: skip


def episode(number, configuration, length):
    return {"number": number, "configuration": configuration, "length": length, "found_complete": [],
            "never_grasped": []}  # fmt: skip


def independent(**changes):
    """Of 8 episodes 6 succeed."""
    tasks = [group.tasks[0] for group in BENCHMARK.groups("independent", "train")]
    episodes = [episode(task, i, int(task != 3)) for task in range(4) for i in range(2)]
    return COMMON | {"suite": "independent"} | independent_results(episodes, tasks) | changes


def sequential(**changes):
    """The 4 chains complete 2, 1, 1 and 0 tasks."""
    chains = [episode(0, 0, 2), episode(0, 1, 1), episode(1, 0, 1), episode(1, 1, 0)]
    numbers = sequential_results(chains, BENCHMARK.groups("sequential", "train"))
    return COMMON | {"suite": "sequential"} | numbers | changes


def entries(*results, policy=None, **flags):
    return make_entries(results, policy or {}, BENCHMARK, ResultsConfig(**flags), training="")


def test_values_and_notes():
    chains, tasks = sequential(), independent()
    first, second = entries(chains, tasks, source_url="https://example.org/log")
    assert (first.task_id, first.value) == ("independent_train", 75.0)
    assert (second.task_id, second.value) == ("sequential_train", 1.0)
    assert second.notes.startswith("n=4; average chain length, 95 % interval 0.")
    assert "SEQ 0, 1, ... 75.0, 25.0 %" in second.notes
    assert "temperature 0.6; sampling seed 3; pixels_agent_pos; cronos-lerobot 0.1.0" in second.notes
    assert first.source_url == "https://example.org/log"
    told = {"reads_privileged_state": True, "observation": {"task_observation": "one_hot"}}
    (one,) = entries(independent(**told))
    assert "; pixels_agent_pos with the privileged state and the task; " in one.notes


@pytest.mark.parametrize(
    ("results", "policy", "said"),
    [
        (independent(n=5), {}, "5 of the 8 episodes of train"),
        (sequential(advance="on_success"), {}, "advance"),
        (sequential(end_effector_reset=True), {}, "end_effector_reset"),
        (independent(renderer="filament"), {}, "filament"),
        (
            independent(policy_config={"n_action_steps": 1}),
            {"n_action_steps": 100},
            "n_action_steps 1 instead of 100",
        ),
    ],
)
def test_what_is_not_the_benchmarks_own_evaluation_is_refused_or_called_so(results, policy, said):
    with pytest.raises(ValueError, match=f"{said}.*--partial"):
        entries(results, policy=policy)
    (entry,) = entries(results, policy=policy, partial=True)
    assert entry.notes.startswith("PARTIAL: ")
    assert said in entry.notes.partition("; n=")[0]


def test_what_does_not_change_single_tasks_is_no_difference():
    changes = {"advance": "on_success", "end_effector_reset": True}
    assert len(entries(independent(**changes))) == 1
    assert len(entries(independent(obs_type="environment_state_agent_pos", renderer="filament"))) == 1


def test_what_flags_changed_of_a_policy():
    published = {"temperature": 0.0, "device": "cpu", "push_to_hub": True, "dtype": "float32", "use_peft": True}
    config = {"temperature": 0.5, "device": "cuda", "push_to_hub": False, "use_peft": False, "dtype": "bfloat16",
              "newer": 1}  # fmt: skip
    assert changes_of_policy({"temperature": 0.6}, published) == []
    results = {"policy_config": config, "temperature": 0.6}
    assert changes_of_policy(results, published) == ["dtype bfloat16 instead of float32"]
    # The policy's own temperature holds if the evaluation gives none.
    own = ["temperature 0.5 instead of 0.0", "dtype bfloat16 instead of float32"]
    assert changes_of_policy(results | {"temperature": None}, published) == own


def test_nothing_to_publish_and_damaged_results():
    with pytest.raises(ValueError, match="--suites"):
        entries(independent(), suites="chains")
    with pytest.raises(ValueError, match="--results"):
        entries(independent(), suites="sequential")
    with pytest.raises(ValueError, match="damaged"):
        entries(independent(ci95=3))


def test_a_benchmark_is_drawn_or_loaded_or_the_packages():
    drawn = choose_benchmark(BenchmarkConfig(seed=0, num_configurations=2, num_orderings=2, chain_length=2))
    assert drawn.fingerprint == BENCHMARK.fingerprint
    assert choose_benchmark(BenchmarkConfig(scene="playroom_2x2")).size("sequential", "train") == 640
    for flags in ({"num_orderings": 2}, {"seed": 0, "benchmark": "me/bench"}):
        with pytest.raises(ValueError, match="--seed"):
            choose_benchmark(BenchmarkConfig(**flags))


# Whose results they are ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [{"policy": "scripted expert"}, {"policy": "me/other"}, {"policy": "outputs/eer"}, {"policy_revision": None}],
)
def test_results_of_something_else_are_refused(tmp_path, changes):
    own = {"policy": "me/eer@main", "policy_revision": "0" * 40} | changes
    write_evaluation(tmp_path, own.pop("policy"), tasks=["11"], **own)
    with pytest.raises(ValueError, match=r"--policy\.path=me/eer"):
        read_own_results(ResultsConfig(repo_id="me/eer", results=tmp_path))


@pytest.fixture
def evaluations(here, tmp_path):
    """Evaluations of a policy in a repository, of one split each."""
    for kind, name in (("models", POLICY), ("datasets", REPOSITORY)):
        here.repositories[kind, name] = Repository(kind, name)
    (tmp_path / "model").mkdir()
    (tmp_path / "model/config.json").write_text('{"type": "act"}')
    revision = here.repositories["models", POLICY].commit_folder(tmp_path / "model").oid
    write_benchmark(BENCHMARK, tmp_path / "bench")
    here.repositories["datasets", REPOSITORY].commit_folder(tmp_path / "bench")
    about = {"source": REPOSITORY, "fingerprint": BENCHMARK.fingerprint}
    for split in ("train", "held_out"):
        more = COMMON | {"policy_revision": revision, "benchmark": about} | {"split": split}
        write_evaluation(tmp_path / split, POLICY, tasks=["11"] * 4, **more)
    return {split: ResultsConfig(repo_id=POLICY, results=tmp_path / split) for split in ("train", "held_out")}


def published(hub):
    return [one["dataset"]["task_id"] for one in yaml.safe_load(hub.tree("models", POLICY)[FILE])]


def test_what_another_has_pushed_meanwhile_is_not_lost(here, evaluations, monkeypatch):
    """Two `cronos-publish results` at once on one repository."""

    def push_after_the_other(*args, **options):
        monkeypatch.setattr("cronos_lerobot.scripts.publish.push_folder", push_folder)
        publish_results(evaluations["held_out"])
        return push_folder(*args, **options)

    monkeypatch.setattr("cronos_lerobot.scripts.publish.push_folder", push_after_the_other)
    with pytest.raises(PublishError, match=f"{POLICY} .* changed meanwhile"):
        publish_results(evaluations["train"])
    assert published(here) == ["independent_held_out"]
    publish_results(evaluations["train"])
    assert published(here) == ["independent_held_out", "independent_train"]


def edit(results, **changes):
    file = results.results / "independent_train/results.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_results_of_another_commit_or_benchmark_are_refused(here, evaluations, tmp_path):
    ours = evaluations["train"]
    (revision,) = {one["policy_revision"] for one in read_evaluation(ours.results)}
    edit(ours, policy_revision="f" * 40)
    with pytest.raises(PublishError, match="f" * 40):
        publish_results(ours)
    edit(ours, policy_revision=revision, benchmark={"source": REPOSITORY, "fingerprint": "0" * 16})
    with pytest.raises(ValueError, match="--benchmark"):
        publish_results(ours)
    edit(ours, benchmark={"source": str(tmp_path / "bench"), "fingerprint": BENCHMARK.fingerprint})
    with pytest.raises(ValueError, match="--benchmark"):
        publish_results(ours)
    (tmp_path / "model/config.json").write_text('{"type": "act", "chunk_size": 2}')
    here.repositories["models", POLICY].commit_folder(tmp_path / "model")
    with pytest.raises(PublishError, match="another policy now"):
        publish_results(evaluations["held_out"])
    assert FILE not in here.tree("models", POLICY)


def test_results_of_somebody_else_tell_no_folders(here, evaluations):
    edit(evaluations["train"], versions={"cronos-lerobot": "/home/melanie/checkout"}, date="hf_" + "a" * 34)
    publish_results(evaluations["train"])
    text = here.tree("models", POLICY)[FILE].decode()
    assert "melanie" not in text
    assert "hf_" not in text
