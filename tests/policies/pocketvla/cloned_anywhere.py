"""Clones a small PocketVLA for three steps and prints a hash of its weights: the same on every processor."""

import hashlib

import numpy as np
import torch
from lerobot_policy_pocketvla import PocketVLAPolicy
from pocketvla_samples import make_batch, make_config

torch.set_num_threads(1)
torch.manual_seed(0)
config = make_config(image=False)
policy = PocketVLAPolicy(config).train()
optimizer = config.get_optimizer_preset().build(policy.get_optim_params())
batch = make_batch(256) | {"action": torch.rand(256, 7) * 2 - 1}
for _ in range(3):
    optimizer.zero_grad()
    policy.forward(batch)[0].backward()
    optimizer.step()
weights = np.concatenate([value.detach().numpy().ravel() for value in policy.state_dict().values()])
print(hashlib.sha256(weights.tobytes()).hexdigest()[:16])
