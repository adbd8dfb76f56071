"""The picture encoder says where the bodies are."""

import math

import pytest
import torch
from lerobot.configs import NormalizationMode
from lerobot.policies import make_pre_post_processors
from lerobot_policy_pocketvla import PocketVLAPolicy
from lerobot_policy_pocketvla.bodies import BODY_PARTS, bodies_named, describe_bodies
from lerobot_policy_pocketvla.pose_encoder import PoseEncoder, View
from pocketvla_samples import CAMERA, make_batch, make_config

ABOVE = View([[2.0, 0, 0, 0], [0, -2.0, 0, 0], [0, 0, -1.0, 1.0]], [[[0, 0, 0], [0, 0.1, 0]], [[0, 0, 0]]])
"""A camera 1 m above the table that looks down and sees half a metre to each side; a long body and a short one."""
FEATURES = {
    CAMERA: {"projection": ABOVE.projection},
    "observation.state": {"names": ["gripper.opening", "ee.x", "ee.y", "ee.z", *"abcdefghi"]},
    "observation.environment_state": {
        "names": [f"{body}.{part}" for body in ("stick", "ball") for part in BODY_PARTS],
        "keypoints": {"ball": ABOVE.keypoints[1], "stick": ABOVE.keypoints[0]},
    },
}


def pose(x: float, y: float, z: float, yaw: float, hand=(0.0, 0.0, 0.0)) -> list[float]:
    """One body of a privileged state, turned about the vertical."""
    c, s = math.cos(yaw), math.sin(yaw)
    return [x, y, z, c, s, 0, -s, c, 0, *(p - h for p, h in zip((x, y, z), hand, strict=True))]


def labelled_config(**options):
    config = make_config(**options)
    config.input_features["observation.environment_state"].shape = (24,)
    config.set_dataset_feature_metadata(FEATURES)
    return config


def labelled_batch(n: int, seed: int = 0) -> dict:
    """Pictures with a bright spot where each body is, both anywhere on the table, the hand at the origin."""
    rng = torch.Generator().manual_seed(seed)
    xy = torch.rand(n, 2, 2, generator=rng) * 0.6 - 0.3
    states = [[v for body in range(2) for v in pose(*xy[i, body].tolist(), 0, 0)] for i in range(n)]
    batch = make_batch(n, seed) | {"observation.environment_state": describe_bodies(torch.tensor(states))}
    images = torch.full((n, 3, 64, 64), 60, dtype=torch.uint8)
    for i in range(n):
        for body in range(2):
            column, row = (((xy[i, body] * torch.tensor([2, -2])) + 1) * 32).long().tolist()
            images[i, body, row - 3 : row + 3, column - 3 : column + 3] = 255
    return batch | {CAMERA: images, "action": torch.zeros(n, 7)}


def test_bodies_are_read_without_the_hands_position_but_pictures_need_it():
    """The SO-101's proprioception is its joints alone."""
    features = FEATURES | {"observation.state": {"names": ["shoulder_pan.pos", "gripper.pos"]}}
    from_state, from_pictures = make_config(observation="environment_state"), make_config(observation="image")
    for config in (from_state, from_pictures):
        config.set_dataset_feature_metadata(features)
    assert (from_state.bodies, from_state.hand) == (["stick", "ball"], [])
    assert from_state.normalization_mapping["ENV"] is NormalizationMode.IDENTITY
    assert from_pictures.bodies == []


def test_bodies_are_described_in_units_of_ten_centimetres_and_by_twice_their_yaw():
    described = describe_bodies(torch.tensor([pose(0.2, -0.1, 0.05, math.pi / 3, hand=(0.1, 0, 0))]))
    assert described.shape == (1, 14)
    torch.testing.assert_close(described[0, :3], torch.tensor([2.0, -1.0, 0.5]))
    torch.testing.assert_close(described[0, 9:12], torch.tensor([1.0, -1.0, 0.5]))
    torch.testing.assert_close(described[0, 12:], torch.tensor([-0.5, math.sqrt(3) / 2]))
    turned = describe_bodies(torch.tensor([pose(0.2, -0.1, 0.05, math.pi / 3 + math.pi, hand=(0.1, 0, 0))]))
    torch.testing.assert_close(turned[0, 12:], described[0, 12:])


def test_only_states_of_bodies_are_read_as_such():
    names = FEATURES["observation.environment_state"]["names"]
    assert bodies_named(names) == ["stick", "ball"]
    assert bodies_named(names[1:]) == bodies_named(["a", "b"]) == bodies_named(None) == []


def test_a_policy_takes_from_a_dataset_where_the_bodies_are():
    config = labelled_config()
    assert (config.bodies, config.hand) == (["stick", "ball"], [1, 2, 3])
    assert config.view == ABOVE
    assert config.normalization_mapping["ENV"] == NormalizationMode.IDENTITY
    assert config.environment_state_width == 28
    preprocessor, _ = make_pre_post_processors(config)
    batch = preprocessor(
        make_batch(2) | {"observation.environment_state": torch.tensor([pose(1, 1, 0, 0) * 2] * 2)}
    )
    assert batch["observation.environment_state"].shape == (2, 28)


def test_a_body_lies_where_its_ray_meets_the_table():
    encoder = PoseEncoder(13, [1, 2, 3], ABOVE, (64, 64), False)
    places = torch.tensor([[[0.5, 0.0], [-0.2, 0.4]]])
    torch.testing.assert_close(encoder._on_table(places), torch.tensor([[[0.25, 0, 0], [-0.1, -0.2, 0]]]))
    maps = torch.zeros(1, 3 + 8, 16, 16)
    truth = describe_bodies(torch.tensor([pose(0.25, 0, 0, math.pi / 2) + pose(-0.1, -0.2, 0, 0)])).reshape(
        1, 2, 14
    )
    # The stick's end lies 0.1 m along its y axis, which now points to -x: u = 0.3, and every v as above.
    columns, rows = [(0.5 + 1) * 8 - 0.5, (0.3 + 1) * 8 - 0.5, (-0.2 + 1) * 8 - 0.5], [7.5, 7.5, 10.7]
    surprise = 0.0
    for point, (column, row) in enumerate(zip(columns, rows, strict=True)):
        # All on the cell above and left of the point: what lies on the three others surprises by 50.
        maps[0, point, int(row), int(column)] = 50.0
        surprise += 50 * (1 - (1 - column % 1) * (1 - row % 1)) / 3
    assert encoder._surprise(maps, truth).item() == pytest.approx(surprise, rel=1e-4)


def test_what_acts_never_sees_the_privileged_state():
    policy = PocketVLAPolicy(labelled_config(temperature=0.0)).eval()
    batch = labelled_batch(4)
    scrambled = batch | {"observation.environment_state": torch.randn(4, 28)}
    blind = {key: value for key, value in batch.items() if key != "observation.environment_state"}
    for other in (scrambled, blind):
        assert torch.equal(policy.select_action(other), policy.select_action(batch))
        assert torch.equal(policy.predict_values(other), policy.predict_values(batch))


def test_cloning_teaches_the_encoder_the_poses_alone():
    policy = PocketVLAPolicy(labelled_config())
    batch = labelled_batch(4)
    loss, _ = policy.forward(batch)
    actor_alone = policy.forward(policy.encode_observation(batch))[0]
    taught = policy.encoder.teach(
        batch[CAMERA], batch["observation.state"], batch["observation.environment_state"]
    )[1]
    torch.testing.assert_close(loss, actor_alone + taught.mean(), atol=1e-3, rtol=1e-3)


def test_the_mean_picture_is_that_of_cloning_with_or_without_labels():
    for policy in (PocketVLAPolicy(labelled_config()), PocketVLAPolicy(make_config())):
        batch = labelled_batch(2)
        for level in (60, 80):
            policy.forward(batch | {CAMERA: torch.full((2, 3, 64, 64), level, dtype=torch.uint8)})
        policy.eval()
        policy.forward(batch)
        policy.select_action(batch)
        torch.testing.assert_close(policy.encoder.mean_picture, torch.full((3, 64, 64), 70.0))


def test_padding_teaches_nothing():
    policy = PocketVLAPolicy(labelled_config(dtype="float32")).eval()
    batch = labelled_batch(4)
    half = {key: value[:2] for key, value in batch.items()}
    padded = policy.forward(batch | {"action_is_pad": torch.tensor([False, False, True, True])})[0]
    torch.testing.assert_close(padded, policy.forward(half)[0])


@pytest.mark.parametrize("head", ["gaussian", "flow"])
def test_without_labels_the_actors_loss_leaves_the_poses_alone(head):
    policy = PocketVLAPolicy(labelled_config(head=head))
    batch = labelled_batch(4) | ({"action": torch.zeros(4, 4, 7)} if head == "flow" else {})
    del batch["observation.environment_state"]
    policy.forward(batch)[0].backward()
    assert all(parameter.grad is None for parameter in policy.encoder.parameters())
    assert any(parameter.grad is not None for parameter in policy.actor.parameters())


def test_places_are_learnt_from_pictures():
    torch.manual_seed(0)
    policy = PocketVLAPolicy(labelled_config(dtype="float32"))
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3)
    policy.train()
    for step in range(150):
        loss, metrics = policy.forward(labelled_batch(32, seed=step))
        optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        optimizer.step()
    # Of half a metre; a cell of the maps is 6 cm wide.
    assert metrics["pose_error_mm"] < 20
