"""Two `cronos-publish results` at once on one repository: neither loses what the other has pushed."""

import json

import pytest
import yaml
from hub_repositories import Repository
from lerobot_env_cronos import gymnasium_id
from lerobot_env_cronos.benchmark.benchmark import draw_benchmark
from lerobot_env_cronos.benchmark.files import write_benchmark

from cronos_lerobot.evaluation.results import independent_results
from cronos_lerobot.evaluation.store import FORMAT
from cronos_lerobot.hub.config import ResultsConfig
from cronos_lerobot.hub.push import PublishError, push_folder
from cronos_lerobot.hub.results import FILE
from cronos_lerobot.scripts.publish import publish_results

POLICY, BENCHMARK = "me/at_once", "me/bench_at_once"


@pytest.fixture
def evaluations(here, tmp_path):
    """Evaluations of a policy in a repository, of one split each."""
    for kind, name in (("models", POLICY), ("datasets", BENCHMARK)):
        here.repositories[kind, name] = Repository(kind, name)
    (tmp_path / "model").mkdir()
    (tmp_path / "model/config.json").write_text('{"type": "act"}')
    revision = here.repositories["models", POLICY].commit_folder(tmp_path / "model").oid
    benchmark = draw_benchmark("kitchen_2x2", seed=0, num_configurations=1, num_orderings=1, chain_length=2)
    write_benchmark(benchmark, tmp_path / "bench")
    here.repositories["datasets", BENCHMARK].commit_folder(tmp_path / "bench")
    tasks = [group.tasks[0] for group in benchmark.groups("independent", "train")]
    one = {"configuration": 0, "length": 1, "found_complete": [], "never_grasped": []}
    scores = independent_results([one | {"number": number} for number in range(len(tasks))], tasks)
    about = {"environment": gymnasium_id("kitchen_2x2"), "source": BENCHMARK, "fingerprint": benchmark.fingerprint}
    for split in ("train", "held_out"):
        results = {
            "format": FORMAT, "policy": POLICY, "policy_revision": revision, "scene": "kitchen_2x2", "seed": 0,
            "temperature": None, "advance": "window", "end_effector_reset": False, "benchmark": about,
            "date": "2026-11-21", "obs_type": "pixels_agent_pos", "versions": {}, "independent": {split: scores},
        }  # fmt: skip
        (tmp_path / split).mkdir()
        (tmp_path / split / "results.json").write_text(json.dumps(results))
    return {split: ResultsConfig(repo_id=POLICY, results=tmp_path / split) for split in ("train", "held_out")}


def published(hub):
    return [one["dataset"]["task_id"] for one in yaml.safe_load(hub.tree("models", POLICY)[FILE])]


def test_what_another_has_pushed_meanwhile_is_not_lost(here, evaluations, monkeypatch):
    def push_after_the_other(*args, **options):
        monkeypatch.setattr("cronos_lerobot.scripts.publish.push_folder", push_folder)
        publish_results(evaluations["held_out"])
        return push_folder(*args, **options)

    monkeypatch.setattr("cronos_lerobot.scripts.publish.push_folder", push_after_the_other)
    with pytest.raises(PublishError, match=rf"^model {POLICY} on .* was changed meanwhile, .* again$"):
        publish_results(evaluations["train"])
    assert published(here) == ["independent_held_out"]
    publish_results(evaluations["train"])
    assert published(here) == ["independent_held_out", "independent_train"]


def test_results_of_a_commit_that_the_repository_no_longer_has(here, evaluations):
    results = evaluations["train"].results / "results.json"
    results.write_text(json.dumps(json.loads(results.read_text()) | {"policy_revision": "f" * 40}))
    with pytest.raises(PublishError, match=f"as it was at {'f' * 40}, a commit that it no longer has: "):
        publish_results(evaluations["train"])
    assert FILE not in here.tree("models", POLICY)
