"""The frozen benchmark configurations."""

import hashlib
import itertools
from importlib import resources

import numpy as np
import pytest
from lerobot_env_cronos import SCENES, CronosVectorEnv, get_scene
from lerobot_env_cronos.benchmark import configurations
from lerobot_env_cronos.benchmark.configurations import (
    CLEARANCE_M,
    OBJECT_YAWS,
    SEED,
    SPLITS,
    footprint_corners,
    footprint_gap,
    load_configurations,
    sample_configuration,
    sample_place,
)

# A change of these is a new version of the environment id.
GOLDEN_SHA256 = {
    "kitchen_2x2": "f08ab525b109e4c28d902d29b98175eb1caf1fa9bb51cce9f28fa228bed3cf7d",
    "kitchen_3x3": "934ee0d6d11d331cfe9f919d59dc76f55f125efb8064a314c3dec605c4fce632",
    "playroom_2x2": "cb704a4868eed4a3ff4e3c532b96101c6cea87d6288470185c1a3139d2686cf9",
}


@pytest.mark.parametrize("scene", SCENES)
def test_data_is_frozen(scene):
    data = resources.files("lerobot_env_cronos").joinpath(f"data/{scene}.json").read_bytes()
    assert hashlib.sha256(data).hexdigest() == GOLDEN_SHA256[scene]


def test_a_seed_draws_what_is_frozen():
    """Poses are rounded in the file, as they are drawn."""
    scene = get_scene("playroom_2x2")
    drawn = np.random.default_rng(SEED)
    frozen = np.concatenate([load_configurations(scene.name, split) for split in SPLITS])
    again = [sample_configuration(scene, drawn).round(6) for _ in range(len(frozen))]
    np.testing.assert_array_equal(again, frozen)


def test_places_are_those_of_a_look_at_each_in_turn(monkeypatch):
    """Among six carpets, and among nine, where there is none: as many are drawn as it takes."""
    monkeypatch.setattr(configurations, "MAX_ATTEMPTS", 700)
    scene, body = get_scene("kitchen_3x3"), "kitchen shovel"
    middles = np.array([[x, y] for x in (0.17, 0.295, 0.42) for y in (-0.15, 0.0, 0.15)])
    others = [footprint_corners("carpet", xy, 0.0) for xy in middles]

    def one_by_one(others, rng):
        for _ in range(700):
            xy, yaw = rng.uniform(scene.spawn_low, scene.spawn_high), rng.choice(OBJECT_YAWS)
            if all(footprint_gap(footprint_corners(body, xy, yaw), o) > CLEARANCE_M for o in others):
                return xy
        return None

    for seed in range(3):
        mine, theirs = np.random.default_rng(seed), np.random.default_rng(seed)
        for _ in range(2):
            pose, _ = sample_place(scene, body, others[:6], mine)
            np.testing.assert_array_equal(pose[:2], one_by_one(others[:6], theirs))
    with pytest.raises(RuntimeError, match="no free place for the kitchen shovel among 9 bodies"):
        sample_place(scene, body, others, mine)
    assert one_by_one(others, theirs) is None
    assert mine.random() == theirs.random()


@pytest.mark.parametrize("scene", SCENES)
def test_splits_have_64_configurations_and_share_none(scene):
    train, held_out = (load_configurations(scene, split) for split in SPLITS)
    n = len(get_scene(scene).bodies)
    assert train.shape == held_out.shape == (64, n, 7)
    distance = np.abs(train[:, None] - held_out[None]).max(axis=(2, 3))
    assert distance.min() > 0.01
    assert len(np.unique(train.reshape(64, -1), axis=0)) == 64


def test_unknown_split_names_the_valid_ones():
    with pytest.raises(ValueError, match=r"'test'.*train.*held_out"):
        load_configurations("kitchen_2x2", "test")


def test_footprint_gap_by_hand():
    plate = footprint_corners("yellow plate", np.array([0.0, 0.0]), 0.0)  # 0.11 x 0.11
    cloth = footprint_corners("cloth", np.array([0.15, 0.02]), 0.0)
    assert footprint_gap(plate, cloth) == pytest.approx(0.04)
    overlapping = footprint_corners("cloth", np.array([0.10, 0.0]), 0.0)
    assert footprint_gap(plate, overlapping) == pytest.approx(-0.01)
    # Turned by 45 degrees, its corner reaches 0.055 * sqrt(2) towards the plate.
    turned = footprint_corners("cloth", np.array([0.15, 0.0]), np.pi / 4)
    assert footprint_gap(plate, turned) == pytest.approx(0.15 - 0.055 - 0.055 * np.sqrt(2))


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("scene", SCENES)
def test_no_two_bodies_touch_and_all_stay_where_they_are(scene, split):
    poses = load_configurations(scene, split)
    bodies = get_scene(scene).bodies
    for configuration in poses:
        yaws = 2 * np.arctan2(configuration[:, 6], configuration[:, 3])
        corners = [footprint_corners(b, configuration[i, :2], yaws[i]) for i, b in enumerate(bodies)]
        assert min(footprint_gap(a, b) for a, b in itertools.combinations(corners, 2)) > CLEARANCE_M - 1e-4
    env = CronosVectorEnv(64, scene, obs_type="environment_state_agent_pos")
    env.scene_reset(np.arange(64), np.arange(64), split)
    still = np.tile([0, 0, 0, 0, 0, 0, 1.0], (64, 1))
    for _ in range(10):
        env.step(still)
    assert np.abs(env.simulation.body_poses() - poses)[..., :3].max() < 2e-3
    assert not env.is_success.any()
