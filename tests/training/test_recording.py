"""Recordings of whole runs: films, and what happens when a recording fails."""

import json
import logging
import resource
import shutil
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from dummies import DummyEnv, DummyPolicy, DummyPolicyConfig, identity_processors
from lerobot.utils.random_utils import set_seed
from lerobot_env_cronos import CronosEnvConfig, CronosVectorEnv
from safetensors.torch import load_file
from test_cronos_train import OBSERVATIONS, SMALL

from cronos_lerobot.agents.base import ActionSample
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.data.drawing import LateCamera
from cronos_lerobot.data.recorder import StreamRecorder
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.data.video import read_frames
from cronos_lerobot.data.writer import RecordingError, SegmentWriter
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.loop_state import Step
from cronos_lerobot.scripts import train as script
from cronos_lerobot.studies.kill_test import RECORDINGS, KillTest, read_segments
from cronos_lerobot.training.config import CronosTrainConfig
from cronos_lerobot.training.record_config import RecordConfig
from cronos_lerobot.training.recording import FILM, FilmedEnv
from cronos_lerobot.training.trainer import Trainer

STREAMS = 4


def config(folder, **options):
    defaults = {
        "policy": DummyPolicyConfig(),
        "output_dir": folder,
        "num_envs": STREAMS,
        "steps": 4 * 8 * STREAMS,
        "protocol": ProtocolConfig(task_switch_interval=4, update_interval=8, scene_reset_interval=16),
        "algorithm": PPOConfig(minibatch_size=16),
        "record": RecordConfig("me/stream", streams="all"),
        "eval_freq": 0,
        "save_freq": 8 * STREAMS,
        "tensorboard": False,
    }
    return CronosTrainConfig(**(defaults | options))


def train(cfg, env=None):
    set_seed(cfg.seed)
    trainer = Trainer(cfg, env or DummyEnv(STREAMS), DummyEnv, DummyPolicy(), *identity_processors())
    trainer.train()
    return trainer


class DiskFullEnv(DummyEnv):
    """From step `at` on, no file may grow beyond `limit` bytes: writing fails as it does on a full disk."""

    at, limit = 10, 6000

    def step(self, actions):
        if self.t == self.at:
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.limit, resource.RLIM_INFINITY))
        return super().step(actions)


@pytest.fixture
def file_size_limit():
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))


def weights(folder):
    return load_file(folder / "checkpoints/last/pretrained_model/model.safetensors")


def test_a_run_outlives_its_recording(tmp_path, file_size_limit, caplog):
    """The numbers fit in the small files, the pictures and rows of the recording do not."""
    train(config(tmp_path / "whole", save_freq=0, record=RecordConfig()))
    with caplog.at_level(logging.WARNING):
        train(config(tmp_path / "run", save_freq=8 * STREAMS, save_checkpoint=False), DiskFullEnv(STREAMS))
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    lines = [json.loads(line) for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert [line["kind"] for line in lines].count("update") == 4
    (stopped,) = [line for line in lines if line["kind"] == "recording"]
    assert stopped["recording"] == "streams"
    assert "File too large" in stopped["reason"]
    assert "RECORDING STOPPED, the training goes on without it" in caplog.text
    assert "is not complete" in caplog.messages[-1]
    assert not (tmp_path / "run/streams/.incomplete").exists()


def test_a_failed_recording_keeps_what_was_flushed_and_is_not_resumed(tmp_path, caplog):
    """Segments until the first checkpoint are there; a run resumed from a later one says why there are no more."""

    class FailingEnv(DummyEnv):
        def step(self, actions):
            if self.t == 10:
                # The folder is gone, as if its disk were: what the writer does next fails.
                staging = tmp_path / "run/streams/.incomplete"
                shutil.rmtree(staging)
                staging.write_text("")
            return super().step(actions)

    train(config(tmp_path / "run"), FailingEnv(STREAMS))
    streams = StreamDataset("me/stream", tmp_path / "run/streams", streaming=True)
    streams.check()
    assert [len(streams.segments_of(i)) for i in range(STREAMS)] == [2] * STREAMS
    train(config(tmp_path / "whole", record=RecordConfig()))
    for name, tensor in weights(tmp_path / "whole").items():
        assert (tensor == weights(tmp_path / "run")[name]).all()

    def resume(steps):
        resumed = config(tmp_path / "run", steps=steps)
        resumed.checkpoint_path = (tmp_path / "run/checkpoints/last").resolve()
        resumed.record.check(tmp_path / "run", STREAMS, CronosEnvConfig(), 4, resume=True)
        with caplog.at_level(logging.WARNING):
            train(resumed)
        assert "ended before the checkpoint and is not resumed" in caplog.text
        caplog.clear()

    resume(6 * 8 * STREAMS)
    assert len(StreamDataset("me/stream", tmp_path / "run/streams", streaming=True).segments) == 2 * STREAMS
    # Somebody has made room.
    shutil.rmtree(tmp_path / "run/streams")
    resume(8 * 8 * STREAMS)
    assert not (tmp_path / "run/streams").exists()


def test_a_recording_that_fails_in_the_flush_of_a_checkpoint_is_told_once(tmp_path, monkeypatch):
    """And not behind the place in the log from which a resumed run goes on."""
    flush, flushes = SegmentWriter.flush, []

    def fail_at_the_second(writer):
        flushes.append(writer)
        if len(flushes) == 2:
            raise RecordingError("the disk is full")
        flush(writer)

    monkeypatch.setattr(SegmentWriter, "flush", fail_at_the_second)
    train(config(tmp_path / "run", steps=16 * STREAMS))
    resumed = config(tmp_path / "run", steps=24 * STREAMS)
    resumed.checkpoint_path = (tmp_path / "run/checkpoints/last").resolve()
    resumed.record.check(tmp_path / "run", STREAMS, CronosEnvConfig(), 4, resume=True)
    train(resumed)
    told = [json.loads(line)["kind"] for line in (tmp_path / "run/metrics.jsonl").read_text().splitlines()]
    assert told.count("recording") == 1


def cronos_train(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["cronos-train", *map(str, arguments)])
    script.main()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--record.root={existing}"], "existing exists; choose another --record.root"),
        (
            ["--record.root={new}", "--record.filmed_streams=1", "--env.render_size=[48,64]"],
            "new_64x48 exists; choose another --record.root",
        ),
        # Nobody may make a folder there, not even root.
        (["--record.root=/proc/1/streams"], "cannot record to /proc/1/streams"),
        (["--record.streams=3"], "record.streams must be at most num_envs=2, got 3"),
        (["--record.filmed_streams=3"], "record.filmed_streams must be at most num_envs=2, got 3"),
        (["--record.streams=some"], "record.streams must be a number or 'all', got 'some'"),
        (["--record.streams=0", "--record.filmed_streams=1"], "record.streams=0 records nothing"),
        (["--record.flush_interval_s=0"], "record.flush_interval_s must be > 0, got 0"),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_a_recording_that_cannot_begin_stops_the_run_at_once(tmp_path, monkeypatch, flags, message):
    (tmp_path / "existing").mkdir()
    (tmp_path / "new_64x48").mkdir()
    flags = [flag.format(existing=tmp_path / "existing", new=tmp_path / "new") for flag in flags]
    with pytest.raises(SystemExit, match=message):
        cronos_train(
            monkeypatch, "--policy.type=pocketvla", "--policy.device=cpu", "--env.type=cronos", "--num_envs=2",
            "--record.repo_id=me/stream", f"--output_dir={tmp_path / 'run'}", *flags,
        )  # fmt: skip
    assert sorted(path.name for path in tmp_path.iterdir()) == ["existing", "new_64x48"]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ({"streams": "all"}, "--record.streams=all records nothing without --record.repo_id"),
        ({"filmed_streams": 2}, "--record.filmed_streams=2 records nothing without --record.repo_id"),
        ({"root": Path("here")}, "--record.root=here records nothing without --record.repo_id"),
        ({"flush_interval_s": 5.0}, "--record.flush_interval_s=5.0 records nothing without --record.repo_id"),
    ],
)
def test_how_to_record_without_a_dataset_is_refused(tmp_path, flags, message):
    with pytest.raises(ValueError, match=message):
        RecordConfig(**flags).check(tmp_path, 4, CronosEnvConfig(), 80, resume=False)
    RecordConfig(**flags).check(tmp_path, 4, CronosEnvConfig(), 80, resume=True)
    RecordConfig().check(tmp_path, 4, CronosEnvConfig(), 80, resume=False)


def test_pictures_that_no_video_has_are_refused_before_anything_is_made(tmp_path):
    def check(env, segment_length=80, **flags):
        RecordConfig("me/stream", **flags).check(
            tmp_path / "run", 4, CronosEnvConfig(**env), segment_length, resume=False
        )

    with pytest.raises(ValueError, match=r"--env\.observation_width are 65 and 128: .* even"):
        check({"observation_height": 65})
    # Nobody draws it.
    check({"observation_height": 65, "obs_type": "environment_state_agent_pos"})
    with pytest.raises(ValueError, match=r"--env\.render_size are 100 and 101: .* even"):
        check({"render_size": (100, 101)}, filmed_streams=1)
    check({"render_size": (100, 101)})
    with pytest.raises(ValueError, match=r"task_switch_interval must be at most 5000 .* 1000 s, got 5001"):
        check({}, segment_length=5001)
    check({}, segment_length=5000)
    assert not (tmp_path / "run").exists()


def test_resuming_without_the_recording_is_told(tmp_path, monkeypatch):
    run = tmp_path / "run"
    flags = (*SMALL, *OBSERVATIONS["state"], "--record.repo_id=me/stream", f"--output_dir={run}")
    cronos_train(monkeypatch, *flags, "--steps=16")
    metrics = (run / "metrics.jsonl").read_bytes()
    shutil.rmtree(run / "streams")
    file = run / "checkpoints/last/pretrained_model/train_config.json"
    with pytest.raises(SystemExit, match=rf"^error: no LeRobotDataset to resume in {run / 'streams'}$"):
        cronos_train(monkeypatch, "--resume=true", f"--config_path={file}", "--steps=32")
    assert (run / "metrics.jsonl").read_bytes() == metrics
    assert not (run / "streams").exists()


def test_filmed_streams_are_a_dataset_of_their_own(tmp_path):
    """Its pictures are those of the states that the policy acted on, at another size."""
    env_config = CronosEnvConfig(obs_type="environment_state_agent_pos", render_size=(48, 64), num_threads=1)
    env = CronosVectorEnv(3, **env_config.gym_kwargs)
    seen = []
    filmed = FilmedEnv(env, 2)
    assert filmed.num_envs == 3
    camera = LateCamera(48, 64, env.simulation.model.nq, env.render_positions)
    recorder = StreamRecorder.open(
        env, "me/film", tmp_path / "film", segment_length=5, streams=2, cameras={"front": camera}
    )
    rng = np.random.default_rng(0)
    obs = filmed.observe()
    for t in range(5):
        seen.append((obs["agent_pos"][:2].copy(), env.render_streams(np.arange(2))))
        action = rng.uniform(env.single_action_space.low, env.single_action_space.high, (3, 7)).astype(np.float32)
        observation = {key: obs[key] for key in ("agent_pos", "environment_state")} | {
            "pixels": {"front": obs[FILM]}
        }
        next_obs, reward, *_, info = filmed.step(action)
        recorder.on_step(
            Step(
                t, observation, env.instructions, ActionSample(action, np.zeros(3), np.zeros(3)), reward,
                info["is_success"], info["diverged"], cut=np.full(3, t == 4), piece=np.zeros(3, int),
                segments_since_reset=np.zeros(3, int), preceded_by=np.full(3, 0 if t else 6),
                interventions=np.zeros(3, int), policy_version=0,
            )
        )  # fmt: skip
        obs = next_obs
    recorder.close()
    env.close()
    streams = StreamDataset("me/film", tmp_path / "film", streaming=True)
    streams.check()
    for stream in range(2):
        (segment,) = streams.segments_of(stream)
        pixels = streams.pixels(segment, "observation.images.front")
        assert pixels.shape == (5, 48, 64, 3)
        for t, (state, pictures) in enumerate(seen[:5]):
            np.testing.assert_array_equal(streams.columns(segment)["observation.state"][t], state[stream])
            assert np.abs(pixels[t].astype(int) - pictures[stream]).mean() < 4
        moments = np.stack([pictures[stream] for _, pictures in seen]).astype(int)
        nearest = [int(np.abs(moments - picture).mean(axis=(1, 2, 3)).argmin()) for picture in pixels]
        assert nearest == [0, 1, 2, 3, 4]


def test_the_first_process_films_its_own_streams():
    config = RecordConfig("me/stream", filmed_streams=3)
    config.check_filmed(3)
    with pytest.raises(ValueError, match=r"filmed_streams must be at most 2, the streams of the first process"):
        config.check_filmed(2)


def test_killed_runs_lose_nothing_that_was_flushed(tmp_path):
    """A real run from pixels, killed before a flush; `studies.kill_test` goes on to twenty random moments."""
    tally = KillTest(tmp_path / "killed", seed=1, report=lambda line: None).run(2)
    assert tally.kills >= 2
    assert tally.segments_checked > 0
    assert tally.segments_dropped > 0
    lines = map(json.loads, (tmp_path / "killed/journal.jsonl").read_text().splitlines())
    ended = Counter((line["recording"], tuple(line["segment"])) for line in lines)
    assert max(ended.values()) > 1, "recorded again"
    for name in RECORDINGS:
        segments = read_segments(tmp_path / "killed/run" / name)
        assert segments.keys() == {segment for recording, segment in ended if recording == name}
    film = tmp_path / "killed/run/streams_96x64"
    (path, *_) = sorted(film.rglob("*.mp4"))
    assert read_frames(path, 0, 8, 5).shape == (8, 64, 96, 3)
