"""The processors: action bounds and normalisation, saved and loaded LeRobot's way."""

import numpy as np
import torch
from lerobot.policies import make_pre_post_processors
from pocketvla_samples import make_batch, make_config

STATS = {
    "observation.state": {"mean": np.full(13, 2.0), "std": np.array([0.0] + [4.0] * 12)},
    "observation.environment_state": {"mean": np.zeros(48), "std": np.ones(48)},
    "action": {"min": np.full(7, -3.0), "max": np.full(7, 5.0), "mean": np.zeros(7), "std": np.ones(7)},
}


def test_states_are_standardised_and_constant_ones_do_not_explode():
    preprocessor, _ = make_pre_post_processors(make_config(), dataset_stats=STATS)
    batch = make_batch(2) | {"observation.state": torch.full((2, 13), 6.0)}
    batch["observation.state"][:, 0] = 2.0 + 1e-4
    state = preprocessor(batch)["observation.state"]
    torch.testing.assert_close(state[:, 1:], torch.full((2, 12), 4 / 4.001))
    # 0.1 mm from a constant is a tenth of what is added to its deviation, not ten thousand.
    torch.testing.assert_close(state[:, 0], torch.full((2,), 0.1), atol=1e-3, rtol=0)
    assert STATS["observation.state"]["std"][0] == 0.0


def test_a_constant_does_not_explode_either_where_lerobot_train_puts_in_other_statistics(tmp_path):
    """As it does with those of its dataset when it goes on from a policy."""
    for processor in make_pre_post_processors(make_config(), dataset_stats=STATS):
        processor.save_pretrained(tmp_path)
    other = STATS | {"observation.state": {"mean": np.full(13, 3.0), "std": np.full(13, 1e-6)}}
    preprocessor, _ = make_pre_post_processors(
        make_config(), pretrained_path=str(tmp_path),
        preprocessor_overrides={"normalizer_processor": {"stats": other}},
    )  # fmt: skip
    state = preprocessor(make_batch(1) | {"observation.state": torch.full((1, 13), 3.0005)})["observation.state"]
    torch.testing.assert_close(state, torch.full((1, 13), 0.5), atol=1e-3, rtol=0)


def test_bridge_bounds_map_to_the_ends_of_the_range_and_back():
    preprocessor, postprocessor = make_pre_post_processors(make_config(), dataset_stats=STATS)
    low = [-0.0287273, -0.0417035, -0.0260939, -0.0809211, -0.092887, -0.2071828, 0.0]
    high = [0.0283097, 0.0408553, 0.0401616, 0.0819205, 0.0779285, 0.2038257, 1.0]
    physical = torch.tensor([low, high])
    normalised = preprocessor(make_batch(2) | {"action": physical})["action"]
    torch.testing.assert_close(normalised, torch.tensor([[-1.0] * 7, [1.0] * 7]), atol=1e-4, rtol=0)
    torch.testing.assert_close(postprocessor(normalised), physical, atol=1e-6, rtol=0)


def test_joints_are_told_in_the_actions_units_of_the_state_as_it_comes(tmp_path):
    """Whatever the normaliser makes of it, which `lerobot-train` may give another dataset's statistics."""
    config = make_config(action_bounds="dataset", joints=[2, 0, 1, 4, 5, 6, -1])
    for processor in make_pre_post_processors(config, dataset_stats=STATS):
        processor.save_pretrained(tmp_path)
    preprocessor, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    batch = make_batch(1) | {
        "observation.state": torch.tensor([[5.0, -3.0, 1.0, 9.0, 3.0, -1.0, 1.0] + [9.0] * 6])
    }
    # From -3 .. 5 to -1 .. 1; the last dimension moves no joint.
    expected = torch.tensor([[0.0, 1.0, -1.0, 0.5, -0.5, 0.0, 0.0]])
    torch.testing.assert_close(preprocessor(batch)["observation.joints"], expected)


def test_joints_are_found_by_their_names_in_the_dataset():
    arm = [f"{joint}.pos" for joint in ("pan", "lift", "gripper")]
    features = {"observation.state": {"names": ["time", *reversed(arm)]}, "action": {"names": arm}}
    config = make_config(action_dim=3, head="flow")
    config.set_dataset_feature_metadata(features)
    assert config.joints == [3, 2, -1]
    features["action"]["names"] = ["dx", "dy", "gripper.pos"]
    config = make_config(action_dim=3, head="flow")
    config.set_dataset_feature_metadata(features)
    assert config.joints == []


def test_dataset_bounds_come_from_the_statistics_and_survive_saving(tmp_path):
    config = make_config(action_bounds="dataset")
    for processor in make_pre_post_processors(config, dataset_stats=STATS):
        processor.save_pretrained(tmp_path)
    preprocessor, postprocessor = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    normalised = preprocessor(make_batch(1) | {"action": torch.full((1, 7), 3.0)})["action"]
    torch.testing.assert_close(normalised, torch.full((1, 7), 0.5))
    torch.testing.assert_close(postprocessor(torch.full((1, 7), 0.5)), torch.full((1, 7), 3.0))
