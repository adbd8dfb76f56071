"""Whole runs in which an expert takes over: resumed, shared out, recorded, with an expert of the user's."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from dummies import DummyEnv, identity_processors
from forked_processes import ScriptedPolicy, WanderingEnv, together
from guiding_expert import Guide
from lerobot.utils.random_utils import set_seed
from test_cronos_train import OBSERVATIONS, SMALL, cronos_train
from test_trainer import STREAMS, KilledError, MortalEnv, assert_same_run, config, metrics, train

from cronos_lerobot.agents.ppo.agent import PPOAgent
from cronos_lerobot.agents.ppo.config import PPOConfig
from cronos_lerobot.agents.steering.agent import SteeringAgent
from cronos_lerobot.data.replay import to_replay_buffer
from cronos_lerobot.data.stream_filter import SegmentFilter, filter_streams
from cronos_lerobot.data.stream_statistics import statistics
from cronos_lerobot.data.streams import StreamDataset
from cronos_lerobot.processes import Processes
from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.experts import EXPERTS
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.report.protocol_names import describe_protocol
from cronos_lerobot.report.runs import Group, read_training_run
from cronos_lerobot.report.tables import intervention_rows
from cronos_lerobot.training.record_config import RecordConfig
from cronos_lerobot.training.trainer import Trainer


def assisted(folder, **options):
    """A run of 32 steps of each stream; whoever fails is taken over the next time."""
    protocol = ProtocolConfig(
        task_switch_interval=4, update_interval=8, scene_reset_interval=16, task_order="random",
        takeover_after=1, takeover_price=2, takeover_expert=options.pop("expert", "guide"),
    )  # fmt: skip
    return config(folder, protocol=protocol, **options)


def takeovers(folder):
    return metrics(folder)[-1]["interventions_by_kind"]["takeover"]


def test_a_resumed_run_is_the_unbroken_one(tmp_path):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    train(assisted(unbroken))
    with pytest.raises(KilledError):
        train(assisted(broken), env=MortalEnv(STREAMS, diverge_at={(5, 1), (21, 2)}))
    assert takeovers(broken) < takeovers(unbroken)
    resumed = assisted(broken)
    resumed.checkpoint_path = (broken / "checkpoints/last").resolve()
    torch.manual_seed(999)
    train(resumed, policy_seed=8)
    assert_same_run(unbroken, broken)


def test_what_the_expert_did_is_counted_apart(tmp_path):
    trainer = train(assisted(tmp_path / "run"), env=DummyEnv(STREAMS))
    assert isinstance(trainer._expert, Guide)
    lines = [line for line in metrics(tmp_path / "run") if line["kind"] == "update"]
    segments = sum(line["rollout"]["segments"] for line in lines)
    taken = sum(line["rollout"]["takeovers"][1] for line in lines)
    assert taken == takeovers(tmp_path / "run") > 0
    assert segments + taken == STREAMS * 8
    assert trainer.loop.attempts.sum() == segments
    by_kind = lines[-1]["interventions_by_kind"]
    # Two scene resets of each of four streams in 32 steps; a takeover costs 2.
    assert lines[-1]["interventions"] == by_kind["scene_reset"] + 2 * taken == 8 + 2 * taken


def test_an_agent_that_cannot_learn_beside_an_expert_is_refused(tmp_path, monkeypatch):
    assert PPOAgent.learns_beside_expert
    assert not SteeringAgent.learns_beside_expert
    monkeypatch.setattr(PPOAgent, "learns_beside_expert", False)
    with pytest.raises(ValueError, match="ppo cannot learn beside an expert"):
        train(assisted(tmp_path / "run"))


def test_an_unknown_expert_is_named_before_anything_is_made(tmp_path):
    with pytest.raises(ValueError, match=r"takeover_expert must be one of .*'scripted'.*got 'nobody'"):
        assisted(tmp_path / "run", expert="nobody")


def train_with(processes, cfg):
    mine = processes.share_of(cfg.num_envs)
    set_seed(cfg.seed)
    env = WanderingEnv(mine.stop - mine.start, mine.start)
    trainer = Trainer(cfg, env, DummyEnv, ScriptedPolicy(seed=processes.rank), *identity_processors(), processes)
    trainer.train()
    parameters = torch.cat([parameter.detach().flatten() for parameter in trainer.policy.parameters()])
    return trainer.loop.state_dict(), parameters.tolist()


def test_two_processes_take_over_as_one_does(tmp_path):
    """Their shares of takeovers differ, so that one has more to learn from than the other."""
    options = {"algorithm": PPOConfig(minibatch_size=4, policy_lr=1e-2, policy_lr_max=1.0), "eval_freq": 0}
    loop, _ = train_with(Processes(), assisted(tmp_path / "one", **options))
    first, second = together(train_with, assisted(tmp_path / "two", **options))
    assert first == second
    assert first[0] == loop
    cost = np.array(loop["takeover_cost"])
    assert cost.sum() > 0
    assert cost[:2].sum() != cost[2:].sum()


def test_recorded_takeovers_are_marked_whole_and_found(tmp_path):
    """Stream 1 diverges in step 5 and stream 2 in step 21, in the middle of segments."""
    run = tmp_path / "run"
    trainer = train(assisted(run, record=RecordConfig(repo_id="me/stream", streams="all"), eval_freq=0))
    streams = StreamDataset("me/stream", root=run / "streams")
    streams.check()
    pieces = [segment for segment in streams.segments if segment.taken_over]
    begun = [piece for piece in pieces if piece.intervention is not Intervention.DIVERGENCE]
    assert len(begun) == takeovers(run) > 0
    assert not any(piece.intervention is Intervention.TAKEOVER for piece in pieces)
    total = 0
    for segment in streams.segments:
        frames = streams.columns(segment, ["intervention", "cronos.log_prob", "action"])
        assert (frames["intervention"] == segment.taken_over).all()
        assert ((frames["cronos.log_prob"] == 0) == segment.taken_over).all()
        # The guide moves along one axis alone, the policy along all seven.
        assert (frames["action"][:, 1:] == 0).all() == segment.taken_over
        total += segment.length * segment.taken_over
    last = [streams.segments_of(stream)[-1] for stream in range(STREAMS)]
    counted = [streams.columns(segment, ["cronos.stream_interventions"]) for segment in last]
    # What was counted up to the last segment; the reset after it is on no frame.
    assert [int(c["cronos.stream_interventions"][-1]) for c in counted] == [
        int(b) - 1 for b in trainer.loop.stream_interventions
    ]
    found = statistics(streams)
    assert found["takeovers"][2] == len(pieces)
    assert found["success"][2] == len(streams.segments) - len(pieces)
    filter_streams(streams, SegmentFilter(takeover=True), "me/expert", tmp_path / "expert")
    expert = StreamDataset("me/expert", root=tmp_path / "expert")
    assert [(s.stream, s.step) for s in expert.segments] == [(s.stream, s.step) for s in pieces]
    assert all(segment.taken_over for segment in expert.segments)
    buffer = to_replay_buffer(streams, ["observation.state"], image_augmentation_function=lambda x: x)
    marked = buffer.complementary_info["is_intervention"][: len(buffer)]
    assert 0 < int(marked.sum()) <= total


def test_cronos_train_with_the_scripted_expert(tmp_path, monkeypatch):
    """Four steps are too few for any task: every stream fails and is taken over from its fifth segment on."""
    output = tmp_path / "run"
    flags = ("--protocol.takeover_after=1", "--protocol.scene_reset_interval=null", "--steps=64", "--save_freq=32")
    cronos_train(monkeypatch, *SMALL, *OBSERVATIONS["state"], *flags, f"--output_dir={output}")
    last = json.loads((output / "metrics.jsonl").read_text().splitlines()[-1])
    assert last["interventions_by_kind"]["takeover"] == last["interventions"] == 2 * 4
    (row,) = intervention_rows([Group("run", [read_training_run(output)])])
    assert (row["takeover"], row["takeover price"]) == (8, 1)
    assert describe_protocol(read_training_run(output).config["protocol"]).endswith("EER, takeovers after 1")


class Pad:
    """A gamepad that LeRobot's driver would read: pushed forward and down, the gripper closing."""

    def start(self):
        pass

    stop = update = start

    def get_deltas(self):
        return 1.0, 0.0, -0.5

    def gripper_command(self):
        return "close"


def test_the_person_of_the_docs(tmp_path, monkeypatch):
    """The example of docs/extending.md, word for word, with LeRobot's gamepad and no hand on it."""
    docs = (Path(__file__).parents[2] / "docs/extending.md").read_text()
    code = re.search(r"```python\n(import numpy[^`]*?register_expert.*?)```", docs, re.DOTALL)
    assert code is not None
    (tmp_path / "my_hands").mkdir()
    (tmp_path / "my_hands/__init__.py").write_text(code[1])
    monkeypatch.syspath_prepend(tmp_path)
    for driver in ("GamepadController", "GamepadControllerHID"):
        monkeypatch.setattr(f"lerobot.teleoperators.gamepad.gamepad_utils.{driver}", Pad)
    output = tmp_path / "run"
    flags = ("--protocol.takeover_after=1", "--protocol.takeover_expert=person", "--steps=64")
    cronos_train(
        monkeypatch, *SMALL, *OBSERVATIONS["state"], "--protocol.discover_packages_path=my_hands", *flags,
        "--protocol.scene_reset_interval=null", f"--output_dir={output}",
    )  # fmt: skip
    last = json.loads((output / "metrics.jsonl").read_text().splitlines()[-1])
    # One pair of hands: of two streams that fail everything one is taken over in each of segments 4 to 7.
    assert last["interventions_by_kind"]["takeover"] == 4
    person = EXPERTS.pop("person")
    action = person.move({"delta_x": 1.0, "delta_y": 0.0, "delta_z": -0.5, "gripper": 0}, np.ones(7))
    assert action.tolist() == [0.028, 0.0, -0.013, 0, 0, 0, 0.0]
    del sys.modules["my_hands"]
