"""Whole runs with a dummy environment and policy: seeds, metrics, evaluations, checkpoints, signals."""

import json
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from dummies import DummyEnv
from runs import (
    STEPS_PER_UPDATE,
    STREAMS,
    KilledError,
    MortalEnv,
    assert_same_run,
    assert_same_weights,
    config,
    killed,
    make_trainer,
    metrics,
    resumed,
    train,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from cronos_lerobot.training.checkpoint import list_checkpoints
from cronos_lerobot.training.config import RecordConfig
from cronos_lerobot.training.run_folder import note_start
from cronos_lerobot.training.stopping import SIGNALS, StopRequest
from cronos_lerobot.training.trainer import Schedule


def test_something_recurs_after_each_multiple():
    schedule, times = Schedule(100), []
    for n in range(0, 400, 64):
        if schedule.due(n):
            times.append(n)
            schedule.last = n
    assert times == [128, 256, 320]
    assert not Schedule(100, last=320).due(399)
    assert not Schedule(0).due(10**9)


def test_a_run_does_not_depend_on_saving_evaluating_and_recording(tmp_path):
    train(config(tmp_path / "busy", record=RecordConfig(repo_id="me/stream", streams="2")))
    train(config(tmp_path / "quiet", eval_freq=0, save_freq=0))
    assert_same_weights(tmp_path / "busy", tmp_path / "quiet")
    assert metrics(tmp_path / "busy", "update") == metrics(tmp_path / "quiet")
    assert [p.name for p in sorted((tmp_path / "quiet/checkpoints").iterdir())] == ["000128", "last"]


def test_metrics_hold_both_axes_and_the_rollouts_success(tmp_path):
    trainer = train(config(tmp_path / "run"))
    lines = metrics(tmp_path / "run")
    kinds = ["evaluation", "update", "update", "evaluation", "update", "update", "evaluation"]
    assert [line["kind"] for line in lines] == kinds
    updates = [line for line in lines if line["kind"] == "update"]
    assert [line["interaction_steps"] for line in updates] == [32, 64, 96, 128]
    # T = 16 resets four streams in updates 2 and 4; streams 1 and 2 diverge once each.
    assert [line["interventions"] for line in updates] == [1, 5, 6, 10]
    assert updates[-1]["interventions_by_kind"]["divergence"] == 2
    assert [line["rollout"]["segments"] for line in updates] == [8, 8, 8, 8]
    first = updates[0]["rollout"]
    # Stream 1 diverges in its second segment, which so becomes its first one since a scene reset.
    assert {position: n for position, (_, n) in first["success_by_segment"].items()} == {"0": 5, "1": 3}
    assert sum(n for _, n in first["success_by_task"].values()) == 8
    assert sum(line["rollout"]["success"] * 8 for line in updates) == trainer.loop.successes.sum()
    assert lines[-1]["n"] == 12
    assert set(lines[-1]["per_task"]) == set(trainer.statistics.instructions)
    manifest = json.loads((tmp_path / "run/manifest.json").read_text())
    assert manifest["finished"]["steps"] == 4 * STEPS_PER_UPDATE


def test_tensorboard_has_every_point_once_after_a_resume(tmp_path):
    train(config(tmp_path / "run", steps=2 * STEPS_PER_UPDATE, tensorboard=True, eval_freq=0))
    train(resumed(tmp_path / "run", steps=4 * STEPS_PER_UPDATE, tensorboard=True, eval_freq=0))
    events = EventAccumulator(str(tmp_path / "run/tensorboard")).Reload()
    (tag,) = (tag for tag in events.Tags()["scalars"] if tag.endswith("steps_per_s"))
    assert [event.step for event in events.Scalars(tag)] == [32, 64, 96, 128]


class SignallingEnv(DummyEnv):
    """Has the process told to stop in the middle of a segment."""

    def step(self, actions):
        if self.t == 21:
            signal.raise_signal(signal.SIGTERM)
        return super().step(actions)


@pytest.mark.parametrize("evaluated_after", [2, 3])
def test_a_run_that_is_told_to_stop_ends_its_update_and_resumes_as_the_unbroken_one(evaluated_after, tmp_path):
    """Saved where no checkpoint was due; an evaluation that is due then is left to the run that resumes."""
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    rarely = {"save_freq": 4 * STEPS_PER_UPDATE, "eval_freq": evaluated_after * STEPS_PER_UPDATE}
    train(config(unbroken, **rarely))
    env = SignallingEnv(STREAMS, diverge_at={(5, 1), (21, 2)})
    with StopRequest() as stop:
        assert not make_trainer(config(broken, **rarely), env=env).train(stop)
    evaluations = [line["interaction_steps"] for line in metrics(broken, "evaluation")]
    assert evaluations == [0, 2 * STEPS_PER_UPDATE][: 4 - evaluated_after]
    again = resumed(broken, **rarely)
    assert again.checkpoint_path.name == f"{3 * STEPS_PER_UPDATE:06d}"
    train(again)
    assert_same_run(unbroken, broken)


@pytest.mark.parametrize("number", SIGNALS)
def test_every_signal_that_ends_a_process_is_noted(number):
    """A dropped connection (SIGHUP) and a cluster's warning (SIGUSR1) as well; what is ignored stays so."""
    before = signal.getsignal(number)
    for handler, expected in ((signal.SIG_IGN, None), (signal.default_int_handler, number)):
        signal.signal(number, handler)
        try:
            with StopRequest() as stop:
                signal.raise_signal(number)
            assert stop.number == expected
            assert signal.getsignal(number) == handler
        finally:
            signal.signal(number, before)


PIPED = """
import os, signal, sys
from cronos_lerobot.training.stopping import StopRequest, end_by
reader, writer = os.pipe()
os.dup2(writer, 1)
os.dup2(writer, 2)
os.close(reader)
with StopRequest() as stop:
    signal.raise_signal(signal.SIGTERM)
open(sys.argv[1], "w").close()
sys.stdout.write("said to nobody")
end_by(stop.number)
"""


def test_a_run_whose_output_nobody_reads_any_more_saves_and_ends_by_the_signal(tmp_path, monkeypatch):
    """As in `2>&1 | tee log`, where Ctrl-C ends `tee` as well."""
    # What was written waits for the flush at the end.
    monkeypatch.delenv("PYTHONUNBUFFERED", raising=False)
    done = subprocess.run([sys.executable, "-c", PIPED, str(tmp_path / "saved")], timeout=60)
    assert (done.returncode, (tmp_path / "saved").exists()) == (-signal.SIGTERM, True)


@pytest.mark.parametrize(("after_s", "ends"), [(0.5, []), (2.5, [signal.SIGTERM])])
def test_a_second_signal_ends_at_once_but_not_an_echo_of_the_first(after_s, ends, monkeypatch):
    ended, clock = [], [100.0]
    monkeypatch.setattr("cronos_lerobot.training.stopping.end_by", ended.append)
    monkeypatch.setattr("cronos_lerobot.training.stopping.time.monotonic", lambda: clock[0])
    with StopRequest() as stop:
        signal.raise_signal(signal.SIGTERM)
        clock[0] += after_s
        signal.raise_signal(signal.SIGTERM)
    assert (stop.number, ended) == (signal.SIGTERM, ends)


@pytest.mark.parametrize(("was", "is_told"), [("AVX2", True), ("AVX512", False)])
def test_resuming_with_other_vector_instructions_is_told(was, is_told, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    manifest = tmp_path / "manifest.json"
    manifest.write_text(json.dumps({"starts": [{"machine": {"cpu_capability": was}}]}))
    note_start(config(tmp_path), DummyEnv.identity)
    assert ("AVX2" in caplog.text) == is_told
    assert len(json.loads(manifest.read_text())["starts"]) == 2


def test_old_checkpoints_are_dropped(tmp_path):
    train(config(tmp_path / "run", keep_checkpoints=2))
    assert sorted(p.name for p in (tmp_path / "run/checkpoints").iterdir()) == ["000096", "000128", "last"]
    assert (tmp_path / "run/checkpoints/last").resolve().name == "000128"


def test_checkpoints_are_in_the_order_of_their_steps_whatever_their_digits(tmp_path):
    """A run that was made longer than a million steps has names of six digits and of seven."""
    for name in ("614400", "0716800", "512000"):
        (tmp_path / name).mkdir()
    assert [path.name for path in list_checkpoints(tmp_path)] == ["512000", "614400", "0716800"]


def test_a_run_that_resumes_from_an_earlier_checkpoint_keeps_what_it_writes(tmp_path):
    train(config(tmp_path))
    with pytest.raises(KilledError):
        train(resumed(tmp_path, "000032", keep_checkpoints=1), env=MortalEnv(STREAMS))
    # One update, from 8 to 16 steps of each stream, then its end: two later ones are of the run before.
    assert (tmp_path / "checkpoints/last").resolve().name == "000064"
    assert (tmp_path / "checkpoints/last/training_state").is_dir()


def test_a_kill_while_saving_leaves_the_last_checkpoint_whole(tmp_path, monkeypatch):
    train(config(tmp_path, steps=STEPS_PER_UPDATE))

    def die(*args, **kwargs):
        raise KilledError

    monkeypatch.setattr("cronos_lerobot.training.checkpoint.torch.save", die)
    with pytest.raises(KilledError):
        train(resumed(tmp_path, steps=2 * STEPS_PER_UPDATE))
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["000032", "last"]
    assert (tmp_path / "checkpoints/last").resolve().name == "000032"


class DeletingEnv(DummyEnv):
    """Somebody removes the run's folder in the middle of it."""

    def step(self, actions):
        if self.t == 10:
            shutil.rmtree(self.folder)
        return super().step(actions)


def test_a_run_whose_folder_is_gone_stops_at_the_next_checkpoint(tmp_path):
    env = DeletingEnv(STREAMS)
    env.folder = tmp_path / "run"
    with pytest.raises(FileNotFoundError, match="run"):
        train(config(tmp_path / "run"), env=env)
    assert not (tmp_path / "run").exists()


class NanEnv(DummyEnv):
    """Its rewards are no numbers from the second update on."""

    def step(self, actions):
        observation, reward, *rest = super().step(actions)
        return observation, reward * (np.nan if self.t > 8 else 1), *rest


def test_a_loss_that_is_no_number_ends_the_run_and_keeps_its_checkpoint(tmp_path):
    with pytest.raises(FloatingPointError):
        train(config(tmp_path), env=NanEnv(STREAMS))
    assert (tmp_path / "checkpoints/last").resolve().name == f"{STEPS_PER_UPDATE:06d}"


def test_recorded_streams_are_whole_and_survive_a_kill(tmp_path):
    from lerobot.datasets import LeRobotDataset

    record = RecordConfig(repo_id="me/stream", streams="2")
    killed(config(tmp_path / "run", record=record))
    train(resumed(tmp_path / "run", record=record))
    data = LeRobotDataset("me/stream", root=tmp_path / "run/streams").hf_dataset.with_format("numpy")
    for stream, events in ((0, [6, 0, 0, 0, 2, 0, 0, 0]), (1, [6, 0, 0, 0, 2, 0, 5, 0])):
        mine = data["cronos.stream_id"][:] == stream
        assert data["cronos.step"][:][mine].tolist() == list(range(32))
        assert data["cronos.event"][:][mine][:8].tolist() == events
        segments = data["cronos.segment_index"][:][mine]
        assert set(np.diff(segments)) <= {0, 1}
        assert data["cronos.policy_version"][:][mine].tolist() == [i // 8 for i in range(32)]
