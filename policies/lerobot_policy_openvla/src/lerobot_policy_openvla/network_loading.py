"""The network of a checkpoint, with its weights. It needs timm, which takes seconds to import."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import torch
from accelerate import init_empty_weights
from accelerate.utils import set_module_tensor_to_device
from safetensors import safe_open
from torch import Tensor

from lerobot_policy_openvla.architecture import Architecture
from lerobot_policy_openvla.checkpoint import WEIGHTS, WEIGHTS_INDEX, Checkpoint, read_json, timm_name
from lerobot_policy_openvla.network import OpenVLANetwork, depth_of

UNUSED = re.compile(
    r"vision_backbone\.(fused_)?featurizer\.(norm|fc_norm|head|attn_pool)\.|.*rotary_emb\.inv_freq$"
)
"""Published tensors that come after what the network looks at, or that are computed."""
VISION_BLOCK = re.compile(r"vision_backbone\.(featurizer|fused_featurizer)\.blocks\.(\d+)\.")


def empty_network(architecture: Architecture, attention: str) -> OpenVLANetwork:
    """Return a network whose parameters take no memory yet."""
    with init_empty_weights(include_buffers=False):
        return OpenVLANetwork(architecture, attention)


def load_network(
    checkpoint: Checkpoint, attention: str, dtype: torch.dtype, device: str | torch.device
) -> OpenVLANetwork:
    """Return the checkpoint's network in evaluation mode.

    One tensor at a time goes from the files to the device, so there is never a second copy in memory.

    Raises:
        ValueError: names or shapes in the files are not those of the network.
    """
    network = empty_network(checkpoint.architecture, attention)
    missing = dict(network.state_dict())
    for name, tensor in _tensors(checkpoint):
        if _is_unused(name, network):
            continue
        expected = missing.pop(name, None)
        if expected is None or expected.shape != tensor.shape:
            shape = "no such tensor" if expected is None else tuple(expected.shape)
            raise ValueError(f"{checkpoint.folder} has {name} {tuple(tensor.shape)}, the network has {shape}.")
        set_module_tensor_to_device(network, name, device, tensor, dtype=dtype)
    if missing:
        raise ValueError(f"{checkpoint.folder} lacks {len(missing)} tensors: {sorted(missing)[:5]} ...")
    return network.to(device).eval()


def _tensors(checkpoint: Checkpoint) -> Iterator[tuple[str, Tensor]]:
    for path in _weight_files(checkpoint.folder):
        with safe_open(path, framework="pt") as file:
            for key in file.keys():  # noqa: SIM118  (it is not a dict)
                if key.startswith(checkpoint.prefix):
                    yield timm_name(key.removeprefix(checkpoint.prefix)), file.get_tensor(key)


def _weight_files(folder: Path) -> list[Path]:
    if (folder / WEIGHTS_INDEX).is_file():
        shards = read_json(folder / WEIGHTS_INDEX)["weight_map"].values()
        return [folder / shard for shard in sorted(set(shards))]
    if (folder / WEIGHTS).is_file():
        return [folder / WEIGHTS]
    raise FileNotFoundError(f"{folder} has neither {WEIGHTS} nor {WEIGHTS_INDEX}.")


def _is_unused(name: str, network: OpenVLANetwork) -> bool:
    if block := VISION_BLOCK.match(name):
        tower = getattr(network.vision_backbone, block[1])
        return int(block[2]) >= depth_of(tower)
    return UNUSED.match(name) is not None
