"""Whole runs with a dummy environment and policy: resuming, seeds, logs, recordings."""

import json
import signal
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
import torch
from dummies import DummyEnv, DummyPolicy, DummyPolicyConfig, identity_processors
from lerobot.utils.random_utils import set_seed
from safetensors.torch import load_file

from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.training.checkpoint import list_checkpoints
from cronos_lerobot.training.config import CronosTrainConfig, PeriodicEvaluationConfig
from cronos_lerobot.training.logging import write_manifest
from cronos_lerobot.training.record_config import RecordConfig
from cronos_lerobot.training.stopping import StopRequest
from cronos_lerobot.training.trainer import Trainer

VOLATILE = ("time", "time_share", "steps_per_s")
STREAMS = 4
STEPS_PER_UPDATE = 4 * 8


def config(folder, steps=4 * STEPS_PER_UPDATE, **options):
    defaults = {
        "policy": DummyPolicyConfig(),
        "output_dir": folder,
        "num_envs": STREAMS,
        "steps": steps,
        "seed": 5,
        "protocol": ProtocolConfig(
            task_switch_interval=4, update_interval=8, scene_reset_interval=16, task_order="random"
        ),
        "algorithm": PPOConfig(minibatch_size=16, policy_lr=1e-2, policy_lr_max=1.0, kl_base_coef=0.1),
        "eval": PeriodicEvaluationConfig(n_episodes=3, batch_size=5),
        "eval_freq": 2 * STEPS_PER_UPDATE,
        "save_freq": STEPS_PER_UPDATE,
        "tensorboard": False,
    }
    return CronosTrainConfig(**(defaults | options))


def make_trainer(cfg, env=None, policy_seed=0):
    set_seed(cfg.seed)
    preprocessor, postprocessor = identity_processors()
    env = env or DummyEnv(STREAMS, diverge_at={(5, 1), (21, 2)})
    return Trainer(cfg, env, DummyEnv, DummyPolicy(seed=policy_seed), preprocessor, postprocessor)


def train(cfg, **options):
    trainer = make_trainer(cfg, **options)
    trainer.train()
    return trainer


def metrics(folder):
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k not in VOLATILE} for line in lines]


def weights(folder):
    return load_file(folder / "checkpoints/last/pretrained_model/model.safetensors")


def assert_same_run(a, b):
    assert metrics(a) == metrics(b)
    for name, tensor in weights(a).items():
        assert torch.equal(tensor, weights(b)[name]), name
    state = "checkpoints/last/training_state"
    assert json.loads((a / state / "loop.json").read_text()) == json.loads((b / state / "loop.json").read_text())
    for name, tensor in load_file(a / state / "optimizer_state.safetensors").items():
        assert torch.equal(tensor, load_file(b / state / "optimizer_state.safetensors")[name]), name
    with np.load(a / state / "env_state.npz") as first, np.load(b / state / "env_state.npz") as second:
        assert all(np.array_equal(first[name], second[name]) for name in first)


class KilledError(Exception):
    pass


class MortalEnv(DummyEnv):
    """Dies in the middle of a segment."""

    def step(self, actions):
        if self.t == 21:
            raise KilledError
        return super().step(actions)


def test_resumed_run_equals_the_unbroken_one(tmp_path):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    train(config(unbroken))
    with pytest.raises(KilledError):
        train(config(broken), env=MortalEnv(STREAMS, diverge_at={(5, 1), (21, 2)}))
    checkpoint = (broken / "checkpoints/last").resolve()
    assert checkpoint.name == f"{2 * STEPS_PER_UPDATE:06d}"
    # Lines after the checkpoint, also half a line, are what a kill may leave.
    with (broken / "metrics.jsonl").open("a") as file:
        file.write('{"kind": "update", "interaction_steps": 96}\n{"kind": "upd')
    resumed = config(broken)
    resumed.checkpoint_path = checkpoint
    # Another policy and another seed of torch: everything must come from the checkpoint.
    torch.manual_seed(999)
    train(resumed, policy_seed=8)
    assert_same_run(unbroken, broken)
    assert len(json.loads((broken / "manifest.json").read_text())["starts"]) == 2


class SignallingEnv(DummyEnv):
    """Has the process told to stop in the middle of a segment."""

    def step(self, actions):
        if self.t == 21:
            signal.raise_signal(signal.SIGTERM)
        return super().step(actions)


@pytest.mark.parametrize("evaluated_after", [2, 3])
def test_a_run_that_is_told_to_stop_ends_its_update_and_resumes_as_the_unbroken_one(evaluated_after, tmp_path):
    """Saved where no checkpoint was due; an evaluation that is due then is left to the run that goes on."""
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    rarely = {"save_freq": 4 * STEPS_PER_UPDATE, "eval_freq": evaluated_after * STEPS_PER_UPDATE}
    train(config(unbroken, **rarely))
    with StopRequest() as stop:
        assert not make_trainer(
            config(broken, **rarely), env=SignallingEnv(STREAMS, diverge_at={(5, 1), (21, 2)})
        ).train(stop)
    assert stop.number == signal.SIGTERM
    evaluations = [line for line in metrics(broken) if line["kind"] == "evaluation"]
    assert [line["interaction_steps"] for line in evaluations] == [0, 2 * STEPS_PER_UPDATE][: 4 - evaluated_after]
    resumed = config(broken, **rarely)
    resumed.checkpoint_path = (broken / "checkpoints/last").resolve()
    assert resumed.checkpoint_path.name == f"{3 * STEPS_PER_UPDATE:06d}"
    assert make_trainer(resumed, policy_seed=8).train()
    assert_same_run(unbroken, broken)


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


def test_ctrl_c_stays_ignored_where_it_is():
    """A shell has it ignored for what it runs in the background."""
    for handler, expected in ((signal.SIG_IGN, None), (signal.default_int_handler, signal.SIGINT)):
        before = signal.signal(signal.SIGINT, handler)
        try:
            with StopRequest() as stop:
                signal.raise_signal(signal.SIGINT)
            assert stop.number == expected
            assert signal.getsignal(signal.SIGINT) == handler
        finally:
            signal.signal(signal.SIGINT, before)


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


def test_evaluations_are_printed(tmp_path, capsys):
    train(config(tmp_path / "run", steps=STEPS_PER_UPDATE), env=DummyEnv(STREAMS))
    first = next(line for line in metrics(tmp_path / "run") if line["kind"] == "evaluation")
    said = f"evaluation, train: {first['success']:.3f} [{first['ci95'][0]:.3f}, {first['ci95'][1]:.3f}], n = "
    assert f"{said}{first['n']}, after 0 steps and 0 interventions" in capsys.readouterr().out


def test_evaluations_at_so_many_interventions(tmp_path):
    """Four streams, reset every 16 steps, updates every 8: 4 counted interventions at every second update."""
    options = {"eval_freq": 0, "eval_at_interventions": [1, 4, 5], "steps": 6 * STEPS_PER_UPDATE}
    train(config(tmp_path / "run", **options), env=DummyEnv(STREAMS))
    found = [
        (line["interaction_steps"], line["interventions"], line["at_interventions"])
        for line in metrics(tmp_path / "run")
        if line["kind"] == "evaluation"
    ]
    spent = {line["interaction_steps"]: line["interventions"] for line in metrics(tmp_path / "run")}
    first = next(n for n, b in sorted(spent.items()) if b >= 4)
    second = next(n for n, b in sorted(spent.items()) if b >= 8)
    assert found[:3] == [(0, 0, []), (first, 4, [1, 4]), (second, 8, [5])]
    # The end is evaluated as always.
    assert [n for n, _, _ in found[3:]] in ([], [6 * STEPS_PER_UPDATE])
    # The run itself is that without them.
    train(config(tmp_path / "without", **options | {"eval_at_interventions": []}), env=DummyEnv(STREAMS))
    for name, tensor in weights(tmp_path / "run").items():
        assert torch.equal(tensor, weights(tmp_path / "without")[name]), name


def test_a_kill_during_the_last_evaluation_does_not_lose_it(tmp_path, monkeypatch):
    short = {"steps": 3 * STEPS_PER_UPDATE, "eval_freq": 2 * STEPS_PER_UPDATE}
    unbroken, broken = config(tmp_path / "unbroken", **short), config(tmp_path / "broken", **short)
    train(unbroken)
    steps = [line["interaction_steps"] for line in metrics(tmp_path / "unbroken") if line["kind"] == "evaluation"]
    assert steps == [0, 2 * STEPS_PER_UPDATE, 3 * STEPS_PER_UPDATE]
    trainer = make_trainer(broken)
    evaluate = trainer._evaluate

    def evaluate_or_die():
        if trainer.loop.n == 3 * STEPS_PER_UPDATE:
            raise KilledError
        evaluate()

    monkeypatch.setattr(trainer, "_evaluate", evaluate_or_die)
    with pytest.raises(KilledError):
        trainer.train()
    resumed = config(tmp_path / "broken", **short)
    resumed.checkpoint_path = (tmp_path / "broken/checkpoints/last").resolve()
    assert resumed.checkpoint_path.name.endswith(str(3 * STEPS_PER_UPDATE))
    train(resumed)
    assert metrics(tmp_path / "broken") == metrics(tmp_path / "unbroken")


def test_same_seed_same_run_other_seed_other_run(tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        train(config(tmp_path / name, seed=seed, steps=2 * STEPS_PER_UPDATE))
    assert_same_run(tmp_path / "a", tmp_path / "b")
    assert metrics(tmp_path / "a") != metrics(tmp_path / "c")


def test_run_does_not_depend_on_saving_evaluating_and_recording(tmp_path):
    train(config(tmp_path / "busy", record=RecordConfig(repo_id="me/stream", streams="2")))
    train(config(tmp_path / "quiet", eval_freq=0, save_freq=0))
    for name, tensor in weights(tmp_path / "busy").items():
        assert torch.equal(tensor, weights(tmp_path / "quiet")[name]), name
    updates = [line for line in metrics(tmp_path / "busy") if line["kind"] == "update"]
    assert updates == metrics(tmp_path / "quiet")
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
    successes = sum(line["rollout"]["success"] * 8 for line in updates)
    assert successes == trainer.loop.successes.sum()
    evaluation = lines[-1]
    assert evaluation["n"] == 12
    assert set(evaluation["per_task"]) == set(trainer.statistics.instructions)


def test_manifest_tells_the_run(tmp_path):
    train(config(tmp_path / "run", steps=1))
    (start,) = json.loads((tmp_path / "run/manifest.json").read_text())["starts"]
    assert start["seed"] == 5
    assert start["versions"]["torch"] == version("torch")
    assert start["config"]["protocol"]["task_switch_interval"] == 4


@pytest.mark.parametrize(("was", "is_told"), [("AVX2", True), ("AVX512", False), (None, False)])
def test_going_on_with_other_vector_instructions_is_told(was, is_told, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "AVX512")
    manifest = tmp_path / "manifest.json"
    # Runs of before have no such note.
    machine = {"cpu_count": 2} if was is None else {"cpu_count": 2, "cpu_capability": was}
    manifest.write_text(json.dumps({"starts": [{"machine": machine, "command": ["cronos-train"]}]}))
    write_manifest(config(tmp_path))
    assert ("This run computed with AVX2 and goes on with AVX512" in caplog.text) == is_told
    assert len(json.loads(manifest.read_text())["starts"]) == 2


def test_old_checkpoints_are_dropped(tmp_path):
    train(config(tmp_path / "run", keep_checkpoints=2))
    names = sorted(p.name for p in (tmp_path / "run/checkpoints").iterdir())
    assert names == ["000096", "000128", "last"]
    assert (tmp_path / "run/checkpoints/last").resolve().name == "000128"


def test_checkpoints_are_in_the_order_of_their_steps_whatever_their_digits(tmp_path):
    """A run that was made longer than a million steps has names of six digits and of seven."""
    for name in ("614400", "0716800", "512000"):
        (tmp_path / name).mkdir()
    assert [path.name for path in list_checkpoints(tmp_path)] == ["512000", "614400", "0716800"]


def test_a_run_that_goes_on_from_an_earlier_checkpoint_keeps_what_it_writes(tmp_path):
    train(config(tmp_path))
    again = config(tmp_path, keep_checkpoints=1)
    again.checkpoint_path = tmp_path / "checkpoints/000032"
    with pytest.raises(KilledError):
        train(again, env=MortalEnv(STREAMS))
    # One update, from 8 to 16 steps of each stream, then its end: two later ones are of the run before.
    assert (tmp_path / "checkpoints/last").resolve().name == "000064"
    assert (tmp_path / "checkpoints/last/training_state").is_dir()


def test_kill_while_saving_leaves_the_last_checkpoint_whole(tmp_path, monkeypatch):
    folder = tmp_path / "run"
    train(config(folder, steps=STEPS_PER_UPDATE))

    def die(*args, **kwargs):
        raise KilledError

    trainer = make_trainer(config(folder, steps=2 * STEPS_PER_UPDATE))
    trainer.config.checkpoint_path = folder / "checkpoints/last"
    monkeypatch.setattr("cronos_lerobot.training.checkpoint.np.savez", die)
    with pytest.raises(KilledError):
        trainer.train()
    assert (folder / "checkpoints/last").resolve().name == "000032"
    assert sorted(p.name for p in (folder / "checkpoints").iterdir()) == ["000032", "last"]


def test_checkpoint_of_another_run_is_refused(tmp_path):
    train(config(tmp_path / "run", steps=STEPS_PER_UPDATE))
    other = config(tmp_path / "other", num_envs=6)
    other.checkpoint_path = tmp_path / "run/checkpoints/last"
    with pytest.raises(ValueError, match="--num_envs=6, but the run that is resumed has 4"):
        make_trainer(other, env=DummyEnv(6)).train()


def test_recorded_streams_are_whole_and_survive_a_kill(tmp_path):
    from lerobot.datasets import LeRobotDataset

    record = RecordConfig(repo_id="me/stream", streams="2")
    with pytest.raises(KilledError):
        train(config(tmp_path / "run", record=record), env=MortalEnv(STREAMS, diverge_at={(5, 1), (21, 2)}))
    resumed = config(tmp_path / "run", record=record)
    resumed.checkpoint_path = (tmp_path / "run/checkpoints/last").resolve()
    train(resumed)
    data = LeRobotDataset("me/stream", root=tmp_path / "run/streams").hf_dataset.with_format("numpy")
    for stream, interventions in ((0, [6, 0, 0, 0, 2, 0, 0, 0]), (1, [6, 0, 0, 0, 2, 0, 5, 0])):
        mine = data["cronos.stream_id"][:] == stream
        assert data["cronos.step"][:][mine].tolist() == list(range(32))
        assert data["cronos.intervention"][:][mine][:8].tolist() == interventions
        segments = data["cronos.segment_index"][:][mine]
        assert set(np.diff(segments)) <= {0, 1}
        assert data["cronos.policy_version"][:][mine].tolist() == [i // 8 for i in range(32)]
