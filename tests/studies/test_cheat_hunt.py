"""The cheat hunt: its trials find version 0's fault, and it knows what was carried."""

import numpy as np
import pytest
from lerobot_env_cronos import get_scene

from cronos_lerobot.studies.cheat_hunt import hunt, parse_args
from cronos_lerobot.studies.cheat_trials import Pair, WatchedSimulation, is_on_v0

PAIR = Pair("ketchup bottle", "yellow plate")


def place(sim: WatchedSimulation, height: float) -> None:
    """The plate at (0.30, 0), the bottle `height` above its top; the rest far away."""
    poses = np.zeros((1, 4, 7))
    poses[..., 3] = 1.0
    poses[0, :, :3] = [
        [0.30, 0, 0.006 + 0.0104 + height],
        [-0.1, -0.4, 0.0106],
        [0.30, 0, 0.003],
        [-0.1, 0.3, 0.0047],
    ]
    sim.place(np.array([0]), poses)


def test_the_gap_is_that_of_the_nearest_surface():
    sim = WatchedSimulation(get_scene("kitchen_2x2"), 1)
    everyone = np.array([0])
    place(sim, 0.020)
    assert sim.gap("ketchup bottle", everyone)[0] == pytest.approx(0.020, abs=1e-6)
    assert sim.gap("kitchen shovel", everyone)[0] == pytest.approx(0.0, abs=1e-6)


def test_both_rules_agree_on_a_bottle_that_lies_on_the_plate():
    sim = WatchedSimulation(get_scene("kitchen_2x2"), 1)
    place(sim, 0.0)
    for _ in range(3):
        sim.step(np.array([[0, 0, 0, 0, 0, 0, 1.0]]), np.array([0]))
    assert is_on_v0(sim, PAIR)[0]
    assert sim.is_on(*PAIR)[0]


def test_a_short_hunt_finds_version_0_s_fault_and_none_of_version_1_s():
    rows, best = hunt("kitchen_2x2", 1, ("v0",), kinds=("push",), population=32)
    assert [row.trials for row in rows] == [32] * 4
    assert sum(row.paid_v0 for row in rows) > 0
    assert sum(row.paid_v1 for row in rows) == 0
    # Two points for each step that was paid, and less than one for anything else.
    assert best["v0"].score > 2 > best["v1"].score


@pytest.mark.parametrize("flags", [["--scene=attic"], ["--trials=0"], ["--rule=v2"]])
def test_wrong_values_are_refused(flags, capsys):
    with pytest.raises(SystemExit):
        parse_args(flags)
    assert "error:" in capsys.readouterr().err
