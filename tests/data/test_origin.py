"""A dataset knows its scene, version and flags, and is resumed only by what is the same."""

import json
from dataclasses import replace

import pytest
from lerobot.datasets import LeRobotDataset
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot_env_cronos import CronosVectorEnv
from lerobot_env_cronos.config import CronosEnvConfig
from synthetic_streams import ORIGIN, record

from cronos_lerobot.data.origin import check_same, flags_of, read_origin
from cronos_lerobot.data.perturbations import NoiseConfig
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.locks import FolderInUseError
from cronos_lerobot.scripts.record_demos import (
    DemoDatasetConfig,
    RecordDemosConfig,
    main,
    open_writer,
    record_demos,
)

STATE = "environment_state_agent_pos"


def command(root, num_episodes=2, scene="kitchen_2x2", **options) -> RecordDemosConfig:
    environment = CronosEnvConfig(scene=scene, obs_type=STATE, num_threads=1)
    dataset = DemoDatasetConfig("me/demos", root, num_episodes)
    return RecordDemosConfig(env=environment, dataset=dataset, num_envs=2, **options)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos") / "d"
    record_demos(command(root, noise=NoiseConfig(share=0.5), seed=7))
    return root


def test_demonstrations_say_how_they_were_made(demos):
    origin = read_origin(demos, LeRobotDataset("me/demos", root=demos).meta.features, "it")
    assert (origin.kind, origin.scene) == ("demonstrations", "kitchen_2x2")
    env = CronosVectorEnv(1, obs_type=STATE)
    assert origin.benchmark == env.benchmark.fingerprint
    env.close()
    flags = {"noise.share": 0.5, "noise.scale": 0.6, "misses.share": 0, "seed": 7, "start.layouts": "train"}
    assert flags.items() <= origin.flags.items()
    assert str(demos.parent) not in json.dumps(origin.flags), "a dataset is published: no folders of its maker"


def test_a_dataset_names_no_folder_of_its_makers_policy(tmp_path):
    config = ACTConfig(device="cpu", pretrained_path=tmp_path)
    assert flags_of(config)["pretrained_path"] == "a folder"
    config.pretrained_path = "me/on_the_hub"
    assert flags_of(config)["pretrained_path"] == "me/on_the_hub"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scene": "playroom_2x2"}, "environment is .*kitchen_2x2-v1.* not .*playroom_2x2-v1"),
        ({"noise": NoiseConfig(share=0.75)}, "--noise.share=0.5, not 0.75"),
        ({"seed": 8}, "--seed=7, not 8"),
        ({"num_episodes": 1}, "--dataset.num_episodes=1"),
    ],
)
def test_demonstrations_are_resumed_as_they_were_begun(demos, changes, message):
    before = {path: path.read_bytes() for path in demos.rglob("*") if path.is_file()}
    options = {"noise": NoiseConfig(share=0.5), "seed": 7, "num_episodes": 4} | changes
    with pytest.raises(ValueError, match=message):
        record_demos(command(demos, resume=True, **options))
    assert {path: path.read_bytes() for path in demos.rglob("*") if path.is_file()} == before


def test_a_dataset_has_one_writer(demos):
    config = command(demos, resume=True, noise=NoiseConfig(share=0.5), seed=7)
    env = CronosVectorEnv(2, obs_type=STATE)
    with open_writer(config, env), pytest.raises(FolderInUseError, match="is being written by process"):
        open_writer(config, env)
    open_writer(config, env).finalize()
    env.close()


def test_lerobots_tools_keep_scene_and_version_but_lose_the_flags(demos, tmp_path):
    edited = delete_episodes(LeRobotDataset("me/demos", root=demos), [0], tmp_path / "d", "me/edited")
    assert not (tmp_path / "d/meta/cronos.json").exists()
    origin = read_origin(edited.root, edited.meta.features, "it")
    assert (origin.kind, origin.scene, origin.flags) == ("demonstrations", "kitchen_2x2", {})
    with pytest.raises(ValueError, match="--seed=None, not 7"):
        check_same(origin, replace(origin, flags={"seed": 7}), "it")


def test_lerobot_does_not_merge_two_versions_or_benchmarks(tmp_path):
    record(tmp_path / "a", steps=4)
    record(tmp_path / "b", steps=4, origin=replace(ORIGIN, benchmark="f" * 16))
    both = [LeRobotDataset("me/stream", root=tmp_path / name) for name in "ab"]
    with pytest.raises(ValueError, match="Same features is expected"):
        merge_datasets(both, "me/both", tmp_path / "both")
    merged = merge_datasets([both[0], both[0]], "me/twice", tmp_path / "twice")
    assert read_origin(merged.root, merged.meta.features, "it").benchmark == ORIGIN.benchmark


@pytest.mark.parametrize(
    ("origin", "message"),
    [
        (None, "format None"),
        (replace(ORIGIN, format=2), "format 2"),
        (replace(ORIGIN, environment="lerobot_env_cronos/kitchen_2x2-v0"), "kitchen_2x2-v0"),
    ],
    ids=["no mark", "format", "environment"],
)
def test_another_format_or_environment_is_refused(tmp_path, origin, message):
    record(tmp_path / "d", steps=4, origin=origin)
    with pytest.raises(ValueError, match=message):
        StreamDataset("me/stream", tmp_path / "d", streaming=True)


@pytest.mark.parametrize(
    "damage", ["{", "[]", '{"format": 3, "environment": "lerobot_env_cronos/kitchen_2x2-v1", "flags": 3}']
)
def test_a_damaged_file_is_named(tmp_path, damage):
    record(tmp_path / "d", steps=4)
    (tmp_path / "d/meta/cronos.json").write_text(damage)
    with pytest.raises(ValueError, match=r"cronos\.json is damaged|format None"):
        StreamDataset("me/stream", tmp_path / "d", streaming=True)


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (["--env.obs_type=pixels", "--env.scene=nowhere"], "error: .*nowhere"),
        (["--num_envs=0"], "error: --num_envs"),
        (["--start.layouts=held_out"], "error: --start.layouts"),
        (["--start.earlier_tasks=0"], "error: --start.earlier_tasks"),
        (["--noise.share=2"], "error: --noise.share"),
        (["--misses.min_offset_m=0.1"], "error: --misses.min_offset_m"),
        (["--resume=true"], "error: no LeRobotDataset to resume in "),
    ],
)
def test_an_error_is_one_line(tmp_path, monkeypatch, flags, line):
    dataset = ["--dataset.repo_id=me/d", f"--dataset.root={tmp_path / 'd'}"]
    command = ["cronos-record-demos", "--env.type=cronos", f"--env.obs_type={STATE}", *dataset, *flags]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit, match=rf"^{line}[^\n]*$"):
        main()
