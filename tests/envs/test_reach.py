"""Layouts over the whole reach of the arm: where bodies may lie, and that the expert can do the tasks there."""

import itertools

import numpy as np
import pytest
from env_rollouts import keep_still, make, run_expert
from lerobot_env_cronos import SCENES, get_scene
from lerobot_env_cronos.benchmark.configurations import (
    CLEARANCE_M,
    footprint_corners,
    footprint_gap,
    load_configurations,
)
from lerobot_env_cronos.expert.reach import find_reach, sample_reach_configuration

N = 16


def draw(scene: str, seed: int = 0, n: int = N) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.stack([sample_reach_configuration(get_scene(scene), rng) for _ in range(n)])


@pytest.mark.parametrize("scene", SCENES)
def test_bodies_lie_free_within_reach_and_in_view(scene):
    poses, bodies = draw(scene), get_scene(scene).bodies
    for layout in poses:
        yaws = 2 * np.arctan2(layout[:, 6], layout[:, 3])
        corners = [footprint_corners(b, layout[i, :2], yaws[i]) for i, b in enumerate(bodies)]
        assert min(footprint_gap(a, b) for a, b in itertools.combinations(corners, 2)) > CLEARANCE_M - 1e-9
    env = make(N, scene)
    env.place_bodies(np.arange(N), poses)
    keep_still(env, 5)
    # Nothing rolls off, and the detector of lost bodies, which looks at the simulation, finds none.
    assert np.abs(env.simulation.body_poses() - poses)[..., :3].max() < 2e-3
    assert not env.unsuitable_bodies().any()


@pytest.mark.parametrize(
    ("place", "within"),
    [
        ((0.30, 0.0), True),
        ((0.14, 0.20), True),
        ((0.30, -0.20), True),
        ((0.05, 0.0), False),  # behind the box of the end effector's target
        ((0.30, 0.29), False),  # beside the front camera's picture
        ((0.49, 0.0), False),  # the hand no longer points down there
        ((0.44, 0.20), False),
        ((0.60, 0.0), False),
    ],
)
def test_reach_by_hand(place, within):
    assert find_reach(get_scene("kitchen_2x2")).contains(np.array(place)) == within


def test_same_seed_same_layouts_and_none_of_the_held_out_ones():
    poses = draw("kitchen_2x2", n=40)
    np.testing.assert_array_equal(poses[:10], draw("kitchen_2x2", n=10))
    assert not np.array_equal(poses[:1], draw("kitchen_2x2", seed=1, n=1))
    held_out = load_configurations("kitchen_2x2", "held_out")
    # Furthest of the bodies from where a held-out configuration has it: never all four near.
    distance = np.linalg.norm(poses[:, None, :, :2] - held_out[None, ..., :2], axis=-1).max(-1)
    assert distance.min() > 0.03


def test_the_expert_does_the_tasks_there():
    env = make(N)
    env.place_bodies(np.arange(N), draw("kitchen_2x2", seed=3))
    env.set_task(np.arange(N), [env.scene.tasks[i % 4] for i in range(N)])
    assert run_expert(env).mean() >= 0.9
