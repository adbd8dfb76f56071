"""A policy cloned from a dataset of the Hub is of that dataset's scene, where LeRobot has downloaded it."""

import shutil
from dataclasses import replace

import pytest
from hub_repositories import Repository
from lerobot.datasets import LeRobotDatasetMetadata
from synthetic_streams import ORIGIN, record
from tiny_checkpoints import write_train_config

from cronos_lerobot.evaluation.policy_env import trained_scene

NAME = "somebody/demos"
KITCHEN, PLAYROOM = ({"scene": scene} for scene in ("kitchen_2x2", "playroom_2x2"))
OF_PLAYROOM = replace(ORIGIN, environment="lerobot_env_cronos/playroom_2x2-v1")


@pytest.fixture
def home(here, tmp_path, monkeypatch):
    """Where LeRobot keeps its datasets; on the Hub one of the playroom, with a branch of the kitchen."""
    for module in ("lerobot.datasets.dataset_metadata", "cronos_lerobot.evaluation.policy_env"):
        monkeypatch.setattr(f"{module}.HF_LEROBOT_HOME", tmp_path / "home")
        monkeypatch.setattr(f"{module}.HF_LEROBOT_HUB_CACHE", tmp_path / "home/hub")
    here.repositories["datasets", NAME] = repository = Repository("datasets", NAME)
    record(tmp_path / "kitchen", steps=4)
    repository.commit_folder(tmp_path / "kitchen", "in/kitchen")
    record(tmp_path / "playroom", steps=4, origin=OF_PLAYROOM)
    repository.tags["v3.0"] = repository.commit_folder(tmp_path / "playroom").oid
    return tmp_path / "home"


def test_the_scene_is_that_of_the_revision_that_was_downloaded(home, here, tmp_path):
    commit = here.repositories["datasets", NAME].tags["v3.0"]

    def scene_at(revision):
        folder = tmp_path / str(revision).replace("/", "_")
        folder.mkdir(exist_ok=True)
        return trained_scene(write_train_config(folder, env=None, dataset={"repo_id": NAME, "revision": revision}))

    assert scene_at(None) == {}, "nothing has been downloaded"
    LeRobotDatasetMetadata(NAME)
    assert (scene_at(None), scene_at("v3.0"), scene_at(commit)) == (PLAYROOM, PLAYROOM, PLAYROOM)
    assert scene_at("in/kitchen") == {}
    LeRobotDatasetMetadata(NAME, revision="in/kitchen")
    assert (scene_at("in/kitchen"), scene_at(None)) == (KITCHEN, PLAYROOM)
    # LeRobot takes one's own first.
    shutil.copytree(tmp_path / "kitchen", home / NAME)
    assert scene_at(None) == KITCHEN
