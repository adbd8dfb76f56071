"""A benchmark on the Hub makes its own environments, by LeRobot's `make_env`."""

import json
import re

import pytest
from hub_repositories import File, Repository

from cronos_lerobot.hub import env_file
from cronos_lerobot.hub.config import BenchmarkConfig
from cronos_lerobot.hub.push import PublishError
from cronos_lerobot.scripts import publish

SMALL = ("--scene=playroom_2x2", "--num_configurations=2", "--num_orderings=2", "--chain_length=2",
         "--pictures=false")  # fmt: skip
SAME = """
import json
from dataclasses import dataclass

import numpy as np
from lerobot.envs import make_env
from lerobot.envs.configs import EnvConfig, HubEnvConfig
from lerobot_env_cronos import CronosEnvConfig

STATE = "environment_state_agent_pos"

@EnvConfig.register_subclass("from_the_hub")
@dataclass
class FromTheHub(HubEnvConfig):
    obs_type: str = STATE

def starts(envs):
    found = {}
    for suite, some in envs.items():
        for number, env in some.items():
            observation, _ = env.reset(seed=[0, 1])
            state = np.asarray(observation["environment_state"]).tolist()
            found[f"{suite} {number}"] = [state, list(env.call("task_description"))]
            env.close()
    return found

def of_the_data(name):
    found = {}
    for suite in ("independent", "sequential"):
        for split in ("train", "held_out"):
            config = CronosEnvConfig(benchmark=name, suite=suite, split=split, obs_type=STATE)
            found |= starts(config.create_envs(2))
    return found

def of_the_hub(name):
    return starts(make_env(FromTheHub(hub_path=name), n_envs=2, trust_remote_code=True))
"""


@pytest.fixture(scope="module")
def commits(served, commands):
    """Two benchmarks of one name, one after the other: commits of the dataset and of the model repository, tag."""
    found = []
    for seed in (5, 6):
        output = commands.run("cronos-publish", "benchmark", "--repo_id=me/env_bench", *SMALL, f"--seed={seed}")
        assert f"{served.url}/datasets/me/env_bench\n{served.url}/me/env_bench\n" in output
        tag = re.search(r"me/env_bench@(benchmark-[0-9a-f]{16}) is this benchmark", output)[1]
        both = [served.repositories[kind, "me/env_bench"] for kind in ("datasets", "models")]
        found.append([repository.branches["main"] for repository in both])
        assert [repository.tags[tag] for repository in both] == found[-1]
        found[-1].append(tag)
    return found


def test_it_gives_the_environments_of_the_repository_at_that_revision(commits, hub, commands):
    (_, old, tag), (data, _, _) = commits
    assert hub.tree("models", "me/env_bench") == hub.tree("datasets", "me/env_bench")
    commands.forget()
    code = f"""{SAME}
old, new = of_the_hub("me/env_bench@{old}"), of_the_hub("me/env_bench")
tagged = of_the_data("me/env_bench@{tag}"), of_the_hub("me/env_bench@{tag}")
are_same = (old, old) == tagged, new == of_the_data("me/env_bench@{data}"), old == new
print(json.dumps([sorted(new), *are_same]))
"""
    names, old_is_old, new_is_new, is_same = json.loads(commands.run("python", code).splitlines()[-1])
    assert names == sorted(
        f"{suite}_{split} {number}"
        for suite, numbers in (("independent", 4), ("sequential", 2))
        for split in ("train", "held_out")
        for number in range(numbers)
    )
    assert (old_is_old, new_is_new, is_same) == (True, True, False)


def test_without_the_plugin_a_sentence_says_what_to_install(commits, commands):
    code = """
import sys
sys.modules["lerobot_env_cronos"] = None
from lerobot.envs import make_env
make_env("me/env_bench", trust_remote_code=True)
"""
    outcome = commands.try_("python", code)
    assert outcome.code == 1
    assert "need the package lerobot_env_cronos" in outcome.output


def test_a_model_or_dataset_of_the_same_name_is_not_overwritten(here, monkeypatch):
    for kind, name, file in (
        ("models", "me/taken", "config.json"),
        ("datasets", "me/my_stream", "meta/info.json"),
    ):
        here.repositories[kind, name] = Repository(kind, name)
        here.repositories[kind, name].commit("main", "mine", {file: File(b"{}", is_lfs=False)}, [])
        with pytest.raises(PublishError, match=name):
            publish.publish_benchmark(BenchmarkConfig(name, pictures=False))
    assert ("datasets", "me/taken") not in here.repositories
    pushed = []
    monkeypatch.setattr(publish, "push_folder", lambda folder, config, kind, *_, **__: str(pushed.append(kind)))
    publish.publish_benchmark(BenchmarkConfig("me/taken", pictures=False, env_hub=False))
    assert pushed == ["dataset"]


def test_a_clone_below_a_folder_that_is_called_like_the_hubs_is_no_download(tmp_path, monkeypatch):
    for folder in ("snapshots/bench", "a--b/snapshots/bench"):
        monkeypatch.setattr(env_file, "__file__", str(tmp_path / folder / "env.py"))
        assert env_file.data_folder() == tmp_path / folder
