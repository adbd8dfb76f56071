"""Task orders and reset strategies that remember something of their own: it is in the checkpoint."""

import numpy as np
import pytest
from test_trainer import STEPS_PER_UPDATE, assert_same_run, config, train

from cronos_lerobot.protocol.config import ProtocolConfig
from cronos_lerobot.protocol.interventions import Intervention
from cronos_lerobot.protocol.own_state import load_own_states, own_states
from cronos_lerobot.protocol.resets import EXTRA_RESETS, SceneReset, make_resets
from cronos_lerobot.protocol.task_orders import TASK_ORDERS


class CountingOrder:
    """Every stream in turn, by a count of its own that `loop` does not have."""

    def __init__(self, rng):
        self.drawn = 0

    def draw(self, loop):
        self.drawn += 1
        return (np.arange(loop.num_streams) + self.drawn * self.drawn) % loop.num_tasks

    def state_dict(self):
        return {"drawn": self.drawn}

    def load_state_dict(self, state):
        self.drawn = state["drawn"]


class EveryThirdSwitch(SceneReset):
    """One stream after the other, at every third switch that it is asked at."""

    kind = Intervention.SCENE_RESET

    def __init__(self, rng, protocol):
        super().__init__(rng, protocol.num_configurations)
        self.asked = {"of": np.zeros(4, int), "history": [1.0]}

    def due(self, env, loop):
        self.asked["of"] += np.arange(1, 5)
        self.asked["history"].append(float(self.asked["of"].sum()))
        return np.flatnonzero(self.asked["of"] % 3 == 0)

    def state_dict(self):
        return self.asked

    def load_state_dict(self, state):
        self.asked = state


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setitem(TASK_ORDERS, "counting", CountingOrder)
    monkeypatch.setitem(EXTRA_RESETS, "every_third", EveryThirdSwitch)


def own(folder, steps=4 * STEPS_PER_UPDATE):
    protocol = ProtocolConfig(
        task_switch_interval=4, update_interval=8, scene_reset_interval=None, task_order="counting",
        extra_resets=("every_third",),
    )  # fmt: skip
    return config(folder, steps, protocol=protocol)


def resume(folder, steps=4 * STEPS_PER_UPDATE):
    resumed = own(folder, steps)
    resumed.checkpoint_path = (folder / "checkpoints/last").resolve()
    return resumed


def test_a_resumed_run_goes_on_with_what_they_kept(tmp_path):
    unbroken, broken = tmp_path / "unbroken", tmp_path / "broken"
    whole = train(own(unbroken))
    # Eight switches, at which stream i has been counted i + 1 further; and two divergences.
    asked = sum(turn * (stream + 1) % 3 == 0 for turn in range(1, 9) for stream in range(4))
    assert whole.loop.b == asked + 2
    train(own(broken, 2 * STEPS_PER_UPDATE))
    train(resume(broken))
    assert_same_run(unbroken, broken)


def test_a_checkpoint_of_before_they_kept_anything_is_read(tmp_path):
    train(own(tmp_path, 2 * STEPS_PER_UPDATE))
    (tmp_path / "checkpoints/last/training_state/strategies.pt").unlink()
    assert train(resume(tmp_path)).loop.n == 4 * STEPS_PER_UPDATE


def test_what_a_checkpoint_cannot_hold_is_refused_before_the_run_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(CountingOrder, "state_dict", lambda self: {"streams": [{"seen": {3}}]})
    with pytest.raises(ValueError, match=r"CountingOrder.state_dict\(\)\['streams'\]\[0\]\['seen'\] is of set: a"):
        train(own(tmp_path))
    assert not (tmp_path / "checkpoints").exists()


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (3, "must return a dict, got 3"),
        ({"a": np.array(["x"], object)}, r"\['a'\] is an array of object"),
        ({"a": np.datetime64("2026-01-01")}, r"\['a'\] is of date"),
        ({(1, 2): 3}, r"has the key \(1, 2\)"),
    ],
)
def test_states_that_are_none(state, message, monkeypatch):
    monkeypatch.setattr(CountingOrder, "state_dict", lambda self: state)
    with pytest.raises(ValueError, match=message):
        own_states([CountingOrder(None)])


def test_a_number_of_numpy_is_a_number(monkeypatch):
    """A mean that begins at 0.0 is one of NumPy's as soon as it is taken."""
    state = {"mean": 0.9 * 0.0 + 0.1 * np.ones(3).mean(), "seen": [np.int64(3), {"any": np.True_}]}
    monkeypatch.setattr(CountingOrder, "state_dict", lambda self: state)
    (kept,) = own_states([CountingOrder(None)]).values()
    assert kept == {"mean": 0.1, "seen": [3, {"any": True}]}
    assert [type(value) for value in (kept["mean"], kept["seen"][0], kept["seen"][1]["any"])] == [float, int, bool]


def test_who_tells_a_state_must_take_it_back(monkeypatch):
    monkeypatch.delattr(CountingOrder, "load_state_dict")
    with pytest.raises(ValueError, match=r"CountingOrder has state_dict\(\) and no load_state_dict"):
        own_states([CountingOrder(None)])


def test_a_run_may_go_on_with_others(tmp_path, caplog):
    train(own(tmp_path, 2 * STEPS_PER_UPDATE))
    other = resume(tmp_path)
    other.protocol.task_order = "heuristic"
    assert train(other).loop.n == 4 * STEPS_PER_UPDATE
    assert "has the state of CountingOrder, which this run does not have" in caplog.text


def test_two_of_one_class_are_told_apart():
    first, second = EveryThirdSwitch(None, ProtocolConfig()), EveryThirdSwitch(None, ProtocolConfig())
    second.asked = {"of": np.ones(4, int), "history": []}
    states = own_states([first, CountingOrder(None), second])
    assert list(states) == ["EveryThirdSwitch", "CountingOrder", "EveryThirdSwitch 2"]
    load_own_states([second, first], states)
    assert (first.asked["history"], second.asked["history"]) == ([], [1.0])


def test_built_in_strategies_keep_nothing():
    protocol = ProtocolConfig(heuristic_reset=True, end_effector_reset=True)
    rng = np.random.default_rng(0)
    orders = [order(rng) for order in set(TASK_ORDERS.values()) - {CountingOrder}]
    assert own_states([*make_resets(protocol, lambda name: rng).all, *orders]) == {}
