"""What is not what a card would say is refused, in one sentence."""

import errno
import json
import shutil
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import delete_episodes
from lerobot_env_cronos.config import CronosEnvConfig
from safetensors.numpy import save_file

from cronos_lerobot.data.file_check import check_dataset
from cronos_lerobot.data.writer import SegmentWriter
from cronos_lerobot.hub.config import PolicyConfig, PublishConfig, StreamConfig
from cronos_lerobot.hub.policy import REPLACES, write_policy_repository
from cronos_lerobot.hub.push import replaced
from cronos_lerobot.hub.results import check_policy
from cronos_lerobot.hub.streams import not_being_recorded, write_stream_repository
from cronos_lerobot.locks import FolderInUseError, FolderLock
from cronos_lerobot.scripts.publish import main
from cronos_lerobot.scripts.record_demos import DemoDatasetConfig, RecordDemosConfig, record_demos


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    """Two demonstrations with a video."""
    root = tmp_path_factory.mktemp("demos") / "d"
    environment = CronosEnvConfig(observation_height=64, observation_width=64, num_threads=1)
    record_demos(RecordDemosConfig(env=environment, dataset=DemoDatasetConfig("me/demos", root, 2), num_envs=2))
    return root


@pytest.fixture
def copy(demos, tmp_path):
    return shutil.copytree(demos, tmp_path / "copy")


def publish(root, folder):
    write_stream_repository(StreamConfig(repo_id="me/d", root=root, dry_run=True, output_dir=folder), folder)
    return (folder / "README.md").read_text()


def test_what_is_whole_is_published_with_its_origin(demos, tmp_path):
    card = publish(demos, tmp_path)
    assert "in the scene `kitchen_2x2` of CRONOS (`lerobot_env_cronos/kitchen_2x2-v1`)" in card
    assert "`--seed=0`" in card


def test_what_is_still_being_recorded_is_not_published_nor_gone_on_with_meanwhile(copy, tmp_path, monkeypatch):
    writer = SegmentWriter.resume("me/demos", copy)
    flags = [f"--root={copy}", "--repo_id=me/d", "--dry_run=true", f"--output_dir={tmp_path / 'out'}"]
    monkeypatch.setattr(sys, "argv", ["cronos-publish", "stream", *flags])
    with pytest.raises(SystemExit, match=rf"^error: {copy} is still being recorded, publish it afterwards: .*\.$"):
        main()
    assert not (tmp_path / "out").exists()
    writer.finalize()

    def write_meanwhile(config, folder):
        with pytest.raises(FolderInUseError, match="is being written by process"):
            SegmentWriter.resume("me/demos", copy)
        return "a dataset"

    monkeypatch.setattr("cronos_lerobot.hub.streams.write_stream_repository", write_meanwhile)
    main()
    SegmentWriter.resume("me/demos", copy).finalize()


def test_a_dataset_that_may_only_be_read_is_published(copy, monkeypatch):
    def read_only(self):
        raise OSError(errno.EROFS, "Read-only file system", str(self.path))

    monkeypatch.setattr(FolderLock, "acquire", read_only)
    with not_being_recorded(copy):
        pass
    monkeypatch.setattr("cronos_lerobot.hub.streams.READ_ONLY", ())
    with pytest.raises(OSError, match="Read-only"), not_being_recorded(copy):
        pass


def only(root, pattern):
    (path,) = root.rglob(pattern)
    return path


def truncate(path, share):
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])


def foreign(root):
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    info["features"]["action"] |= {"shape": [6], "names": [f"joint_{i}" for i in range(6)]}
    path.write_text(json.dumps(info))


def without_rows(root):
    path = only(root, "data/*/*.parquet")
    pq.write_table(pq.read_table(path).slice(0, 5), path)


def forgetful(root):
    (root / "meta/cronos.json").unlink()
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    del info["features"]["next.success"]
    path.write_text(json.dumps(info))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda root: truncate(only(root, "data/*/*.parquet"), 0.5),
            r"data/chunk-000/file-000.parquet is damaged",
        ),
        (lambda root: only(root, "data/*/*.parquet").unlink(), r"data/chunk-000/file-000.parquet is missing"),
        (without_rows, r"file-000.parquet has 5 frames of episode 0, meta/episodes has \d+"),
        (lambda root: only(root, "*.mp4").unlink(), r"front/chunk-000/file-000.mp4 is missing"),
        (
            lambda root: truncate(only(root, "*.mp4"), 0.6),
            r"front/chunk-000/file-000.mp4 (is damaged|has \d+ frames)",
        ),
        (lambda root: only(root, "meta/tasks.parquet").unlink(), "/meta/tasks.parquet is missing"),
        (lambda root: only(root, "meta/episodes/*/*.parquet").unlink(), "/meta/episodes is missing"),
        (foreign, r"the actions are \['joint_0', .*, those of the WidowX are"),
        (forgetful, "does not say which version of the environment made it"),
    ],
)
def test_damaged_and_foreign_datasets_are_refused(copy, tmp_path, damage, message):
    damage(copy)
    with pytest.raises(ValueError, match=message):
        publish(copy, tmp_path / "out")
    assert not (tmp_path / "out").exists(), "nothing is written before everything has been read"


def test_a_dataset_that_lerobot_has_edited_lacks_what_the_card_promises(demos, tmp_path):
    edited = delete_episodes(LeRobotDataset("me/demos", root=demos), [0], tmp_path / "d", "me/edited")
    with pytest.raises(ValueError, match=r"meta/episodes has lost the columns \['cronos.configuration'"):
        check_dataset(edited.root)


def policy(folder, actions=7):
    folder.mkdir()
    features = {"action": {"type": "ACTION", "shape": [actions]}}
    config = {"type": "act", "input_features": {}, "output_features": features}
    (folder / "config.json").write_text(json.dumps(config))
    save_file({"weight": np.zeros((100, 100), np.float32)}, folder / "model.safetensors")
    return folder


def test_a_policy_that_cannot_be_loaded_or_is_of_another_robot_is_refused(tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    write_policy_repository(PolicyConfig(repo_id="me/p", path=policy(tmp_path / "good")), out)
    assert "\nAn `act` policy for the CRONOS scenes" in (out / "README.md").read_text()
    with pytest.raises(ValueError, match="has actions \\[6\\], those of the WidowX are 7"):
        write_policy_repository(PolicyConfig(repo_id="me/p", path=policy(tmp_path / "six", 6)), out)
    truncate(policy(tmp_path / "broken") / "model.safetensors", 0.5)
    with pytest.raises(ValueError, match=r"broken/model.safetensors is damaged"):
        write_policy_repository(PolicyConfig(repo_id="me/p", path=tmp_path / "broken"), out)


@pytest.mark.parametrize("name", ["justname", "me/a/b", "me/with space"])
def test_a_repository_has_an_owner_and_a_name(name):
    with pytest.raises(ValueError, match=f"--repo_id={name} is no <owner>/<name>"):
        PublishConfig(repo_id=name).validate()


@pytest.mark.parametrize("evaluated", ["scripted expert", "me/other", "outputs/train/eer"])
def test_results_of_something_else_are_refused(evaluated):
    check_policy({"policy": "me/eer@main", "policy_revision": "0" * 40}, "me/eer")
    with pytest.raises(ValueError, match=rf"the results are of .*{evaluated}.*, not of .*me/eer"):
        check_policy({"policy": evaluated}, "me/eer")


def test_results_of_a_folder_called_like_a_repository_are_refused():
    with pytest.raises(ValueError, match="are of a folder called me/eer, not of the repository"):
        check_policy({"policy": "me/eer", "policy_revision": None}, "me/eer")


def test_a_policy_that_is_pushed_again_leaves_nothing_that_would_be_loaded_with_it():
    there = ["steering.safetensors", "adapter_model.safetensors", "adapter_config.json", "tokenizer.model",
             "curves/old.png", "config.json", "model-00001-of-00002.safetensors", "model.safetensors.index.json",
             "policy_preprocessor_step_5_normalizer_processor.safetensors",
             "policy_postprocessor.json"]  # fmt: skip
    kept = [".eval_results/me_bench.yaml", "README.md", ".gitattributes", "requirements.txt", "LICENSE.txt",
            "checkpoints/5000/model.safetensors", "onnx/config.json", "notes.json", "demo_actions.safetensors",
            "model_of_mine.safetensors", "policy_notes.json", "dataset_statistics.json"]  # fmt: skip
    assert replaced([*there, *kept], REPLACES) == there
