"""A PocketVLA of a few thousand parameters that reads the privileged state."""

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot_policy_pocketvla import PocketVLAConfig, PocketVLAPolicy


def make_pocketvla(head):
    torch.manual_seed(0)
    options = {"chunk_size": 3, "n_action_steps": 3} if head == "flow" else {}
    config = PocketVLAConfig(
        head=head, device="cpu", hidden_width=16, hidden_depth=1, flow_width=16, flow_depth=1, push_to_hub=False,
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (5,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (6,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))}, **options,
    )  # fmt: skip
    return PocketVLAPolicy(config).eval()
