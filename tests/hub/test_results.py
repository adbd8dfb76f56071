"""Entries of `.eval_results/cronos.yaml`, from numbers that are known."""

import json
from dataclasses import replace

import pytest
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark
from lerobot_env_cronos.scene.scenes import Task
from safetensors.numpy import save_file
from synthetic_streams import ORIGIN
from synthetic_streams import record as record_streams

from cronos_lerobot.evaluation.results import independent_results, sequential_results
from cronos_lerobot.hub.benchmark import choose_benchmark
from cronos_lerobot.hub.config import BenchmarkConfig, PolicyConfig, PublishConfig, ResultsConfig
from cronos_lerobot.hub.policy import write_policy_repository
from cronos_lerobot.hub.results import make_entries, merge
from cronos_lerobot.hub.runs import describe_observation, find_checkpoint, is_repository

BENCHMARK = draw_benchmark("kitchen_2x2", seed=0, num_configurations=2, num_orderings=2, chain_length=2)


APART: dict[str, list] = {"found_complete": [], "never_grasped": []}


def record(number, configuration, length):
    return {"number": number, "configuration": configuration, "length": length} | APART


def make_results(**changes):
    """Of 8 episodes 6 succeed; the 4 chains complete 2, 1, 1 and 0 tasks."""
    tasks: list[Task] = [group.tasks[0] for group in BENCHMARK.groups("independent", "train")]
    episodes = [record(task, i, int(task != 3)) for task in range(4) for i in range(2)]
    chains = [record(0, 0, 2), record(0, 1, 1), record(1, 0, 1), record(1, 1, 0)]
    return {
        "independent": {"train": independent_results(episodes, tasks)},
        "sequential": {
            "train": sequential_results(
                chains, [group.tasks for group in BENCHMARK.groups("sequential", "train")], BENCHMARK.scene
            )
        },
        "temperature": 0.6, "seed": 3, "advance": "window", "end_effector_reset": False, "date": "2026-11-21",
        "obs_type": "pixels_agent_pos", "versions": {"cronos-lerobot": "0.1.0", "lerobot_env_cronos": "0.1.0"},
    } | changes  # fmt: skip


def test_values_and_notes():
    config = ResultsConfig(repo_id="me/p", source_url="https://example.org/log")
    independent, sequential = make_entries(make_results(), BENCHMARK, config)
    assert (independent.task_id, independent.value) == ("independent_train", 75.0)
    assert (sequential.task_id, sequential.value) == ("sequential_train", 1.0)
    assert sequential.notes is not None
    assert sequential.notes.startswith("n=4; average chain length, 95 % interval 0.")
    assert "SEQ 0, 1, ... 75.0, 25.0 %" in sequential.notes
    assert "temperature 0.6; seed 3; pixels_agent_pos; cronos-lerobot 0.1.0" in sequential.notes
    assert independent.source_url == "https://example.org/log"
    seen = {"reads_privileged_state": True, "identity": {"task_observation": "one_hot"}}
    entries = make_entries(make_results(**seen), BENCHMARK, config)
    assert "; pixels_agent_pos with the privileged state and the task; " in str(entries[0].notes)


def test_a_part_of_the_benchmark_is_refused_or_called_so():
    results = make_results()
    results["independent"]["train"]["n"] = 5
    with pytest.raises(ValueError, match="independent_train: 5 of the 8 episodes of train were evaluated"):
        make_entries(results, BENCHMARK, ResultsConfig())
    (entry,) = make_entries(results, BENCHMARK, ResultsConfig(suites="independent", partial=True))
    assert entry.notes is not None
    assert entry.notes.startswith("PARTIAL: 5 of the 8 episodes")


def test_as_many_episodes_of_fewer_configurations_are_a_part():
    results = make_results(repetitions=4)
    for scores in results["independent"].values():
        scores["n"] *= 4
    with pytest.raises(ValueError, match="independent_train: every configuration was run 4 times"):
        make_entries(results, BENCHMARK, ResultsConfig())
    # Chains are not repeated.
    assert len(make_entries(results, BENCHMARK, ResultsConfig(suites="sequential"))) == 1


@pytest.mark.parametrize("change", [{"advance": "on_success"}, {"end_effector_reset": True}])
def test_other_chains_than_the_benchmarks_are_refused(change):
    with pytest.raises(ValueError, match=f"sequential_train: evaluated with {{'{next(iter(change))}'"):
        make_entries(make_results(**change), BENCHMARK, ResultsConfig())
    # Single tasks do not depend on it.
    assert len(make_entries(make_results(**change), BENCHMARK, ResultsConfig(suites="independent"))) == 1


def test_pictures_of_another_renderer_are_refused_or_called_so():
    results = make_results(identity={"renderer": "filament"})
    with pytest.raises(ValueError, match="the policy saw pictures of the renderer filament"):
        make_entries(results, BENCHMARK, ResultsConfig())
    assert len(make_entries(make_results(identity={}), BENCHMARK, ResultsConfig())) == 2


def test_a_policy_that_flags_changed_is_refused_or_called_so():
    changes = ["n_action_steps 1 in place of 100", "temperature 0.5 in place of 0.0"]
    with pytest.raises(ValueError, match="independent_train: flags changed the policy: n_action_steps 1 in place"):
        make_entries(make_results(), BENCHMARK, ResultsConfig(), changes)
    for entry in make_entries(make_results(), BENCHMARK, ResultsConfig(partial=True), changes):
        assert entry.notes is not None
        assert entry.notes.startswith(f"PARTIAL: flags changed the policy: {', '.join(changes)}; n=")


def test_a_note_names_every_way_in_which_an_evaluation_is_another():
    results = make_results(identity={"renderer": "filament"}, advance="on_success")
    results["sequential"]["train"]["n"] = 3
    (entry,) = make_entries(results, BENCHMARK, ResultsConfig(suites="sequential", partial=True))
    assert entry.notes is not None
    assert entry.notes.startswith("PARTIAL: 3 of the 4 chains of train were evaluated; the policy saw pictures of")
    assert "; evaluated with {'advance': 'on_success'}, the benchmark has" in entry.notes


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "camera `front` and `bridge`, 128 x 64 px"),
        ({"renderer": "classic"}, "camera `front` and `bridge`, 128 x 64 px"),
        ({"renderer": "filament"}, "camera `front` and `bridge`, 128 x 64 px, drawn by filament"),
        ({"task_observation": "none"}, "camera `front` and `bridge`, 128 x 64 px"),
        ({"obs_type": "environment_state_agent_pos"}, "privileged state: the poses of all bodies"),
        (
            {"obs_type": "environment_state_agent_pos", "task_observation": "one_hot"},
            "privileged state: the poses of all bodies, with the task in `observation.state`",
        ),
    ],
)
def test_an_observation_in_words(changes, text):
    env = {
        "obs_type": "pixels_agent_pos", "camera_name": "front, bridge", "observation_width": 128,
        "observation_height": 64, "privileged_state": False,
    }  # fmt: skip
    assert describe_observation(env | changes) == text


def test_nothing_to_publish():
    with pytest.raises(ValueError, match=r"unknown suites \['chains'\]; valid suites: \['independent', 'seq"):
        make_entries(make_results(), BENCHMARK, ResultsConfig(suites="chains"))
    results = make_results()
    del results["sequential"]
    with pytest.raises(ValueError, match=r"none of the suites \['sequential'\]"):
        make_entries(results, BENCHMARK, ResultsConfig(suites="sequential"))


def test_merging_replaces_only_the_same_benchmark_and_task():
    def entry(dataset, task, value):
        return {"dataset": {"id": dataset, "task_id": task}, "value": value}

    there = [entry("me/b", "x", 1), entry("other/b", "x", 2), entry("me/b", "y", 3)]
    new = [entry("me/b", "z", 4), entry("me/b", "x", 5)]
    assert [e["value"] for e in merge(there, new)] == [5, 2, 3, 4]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({}, "--repo_id=<owner>/<name> is required"),
        ({"repo_id": "me/x", "revision": "v1"}, "there is no --branch"),
        ({"repo_id": "me/x", "dry_run": True}, "go together"),
    ],
)
def test_flags_that_do_not_fit(flags, message):
    with pytest.raises(ValueError, match=message):
        PublishConfig(**flags).validate()


def test_a_benchmark_is_drawn_or_loaded_or_the_packages():
    drawn = choose_benchmark(BenchmarkConfig(seed=0, num_configurations=2, num_orderings=2, chain_length=2))
    assert drawn.fingerprint == BENCHMARK.fingerprint
    assert choose_benchmark(BenchmarkConfig(scene="playroom_2x2")).size("sequential", "train") == 640
    with pytest.raises(ValueError, match="--num_orderings: of a benchmark that is drawn; give a --seed"):
        choose_benchmark(BenchmarkConfig(num_orderings=2))
    with pytest.raises(ValueError, match="choose"):
        choose_benchmark(BenchmarkConfig(seed=0, benchmark="me/bench"))


def test_a_dry_run_overwrites_nothing(tmp_path):
    (tmp_path / "thesis.txt").touch()
    with pytest.raises(FileExistsError, match="is not empty"):
        PublishConfig(repo_id="me/x", dry_run=True, output_dir=tmp_path).validate()


def test_where_a_policy_may_be(tmp_path):
    model = tmp_path / "run/checkpoints/000100/pretrained_model"
    model.mkdir(parents=True)
    for name in ("config.json", "model.safetensors"):
        (model / name).touch()
    (tmp_path / "run/checkpoints/last").symlink_to("000100")
    for path in (tmp_path / "run", model.parent, model):
        assert find_checkpoint(path).model == model
        assert find_checkpoint(path).run is None, "lerobot-train's: no metrics.jsonl"
    for name in ("metrics.jsonl", "manifest.json"):
        (tmp_path / "run" / name).touch()
    for path in (tmp_path / "run", model.parent, model):
        found = find_checkpoint(path)
        assert (found.run, found.step) == (tmp_path / "run", 100)
    with pytest.raises(FileNotFoundError, match="holds no policy"):
        find_checkpoint(tmp_path)


def write_clone(model, env, **dataset):
    """A checkpoint of lerobot-train; without an `env` in its config, as after training on demonstrations alone."""
    model.mkdir(parents=True)
    actions = {"action": {"type": "ACTION", "shape": [7]}}
    (model / "config.json").write_text(json.dumps({"type": "cronos_mlp", "output_features": actions}))
    save_file({}, model / "model.safetensors")
    (model / "train_config.json").write_text(
        json.dumps({"env": env, "dataset": {"repo_id": "me/demos"} | dataset})
    )
    return model


@pytest.mark.parametrize(
    ("env", "scene", "flag"),
    [
        (None, None, ""),
        (None, "playroom_2x2", "--env.scene=playroom_2x2 "),
        ({"scene": "kitchen_3x3"}, None, "--env.scene=kitchen_3x3 "),
        ({"scene": "kitchen_3x3"}, "kitchen_3x3", "--env.scene=kitchen_3x3 "),
    ],
)
def test_the_scene_in_the_card_of_a_clone(tmp_path, env, scene, flag):
    model = write_clone(tmp_path / "model", env)
    (tmp_path / "repository").mkdir()
    config = PolicyConfig(repo_id="me/clone", path=model, scene=scene)
    assert write_policy_repository(config, tmp_path / "repository") == "cronos_mlp policy"
    card = (tmp_path / "repository/README.md").read_text()
    assert f"lerobot-eval --policy.path=me/clone --env.type=cronos {flag}--env.obs_type=" in card
    assert "Demonstrations: [me/demos]" in card


def test_a_card_for_another_scene_is_refused(tmp_path):
    config = PolicyConfig(path=write_clone(tmp_path / "model", {"scene": "kitchen_3x3"}), scene="kitchen_2x2")
    with pytest.raises(ValueError, match="--scene=kitchen_2x2, but the policy was trained in kitchen_3x3"):
        write_policy_repository(config, tmp_path)


def test_the_scene_of_a_clone_is_that_of_its_demonstrations(tmp_path):
    record_streams(
        tmp_path / "demos", steps=4, origin=replace(ORIGIN, environment="lerobot_env_cronos/playroom_2x2-v1")
    )
    model = write_clone(tmp_path / "model", None, root=str(tmp_path / "demos"))
    (tmp_path / "repository").mkdir()
    write_policy_repository(PolicyConfig(repo_id="me/clone", path=model), tmp_path / "repository")
    card = (tmp_path / "repository/README.md").read_text()
    assert "lerobot-eval --policy.path=me/clone --env.type=cronos --env.scene=playroom_2x2 --env.obs_type=" in card
    with pytest.raises(ValueError, match="--scene=kitchen_2x2, but the policy was trained in playroom_2x2"):
        write_policy_repository(PolicyConfig(path=model, scene="kitchen_2x2"), tmp_path / "repository")


def test_what_can_be_a_repository(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "outputs/clone").mkdir(parents=True)
    assert is_repository("me/base")
    assert not any(map(is_repository, ("outputs/clone", "./base", "/me/base", "a/b/c", None, "base")))
