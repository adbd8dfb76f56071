"""The network and its weights: two vision towers, a projector and Llama, by the names of published checkpoints.

It needs timm, which takes seconds to import.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import timm
import torch
from accelerate import init_empty_weights
from accelerate.utils import set_module_tensor_to_device
from safetensors import safe_open
from timm.models import VisionTransformer
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812
from transformers import LlamaConfig, LlamaForCausalLM

from lerobot_policy_openvla.architecture import Architecture
from lerobot_policy_openvla.checkpoint import WEIGHTS, WEIGHTS_INDEX, Checkpoint, read_json, timm_name

UNUSED = re.compile(
    r"vision_backbone\.(fused_)?featurizer\.(norm|fc_norm|head|attn_pool)\.|.*rotary_emb\.inv_freq$"
)
"""Published tensors that come after what the network looks at, or that are computed."""
VISION_BLOCK = re.compile(r"vision_backbone\.(featurizer|fused_featurizer)\.blocks\.(\d+)\.")
VALUE_WIDTHS = (512, 128)


def depth_of(tower: Any) -> int:
    """Blocks of a timm vision transformer."""
    return len(tower.blocks)


class VisionTower(nn.Module):
    """Patch tokens of the second-to-last block of a DINOv2 and of a SigLIP, side by side.

    What comes after that block (the last block, the norm, the pooling) is never looked at and left out.
    """

    featurizer: VisionTransformer
    fused_featurizer: VisionTransformer

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        towers = []
        for name, activation in zip(architecture.timm_model_ids, architecture.act_layers, strict=True):
            tower = timm.create_model(
                name, pretrained=False, num_classes=0, img_size=architecture.image_size, act_layer=activation
            )
            assert isinstance(tower, VisionTransformer)
            tower.prune_intermediate_layers([depth_of(tower) - 2], prune_norm=True)
            # timm's SigLIP keeps a pooling that nothing here calls.
            tower.attn_pool = None
            towers.append(tower)
        self.featurizer, self.fused_featurizer = towers

    @property
    def width(self) -> int:
        """Channels of the result."""
        return self.featurizer.embed_dim + self.fused_featurizer.embed_dim

    @property
    def num_patches(self) -> int:
        """Patches P of an image."""
        return self.featurizer.patch_embed.num_patches

    def forward(self, pixels: Tensor) -> Tensor:
        """Map pixel values (B, 6, size, size) to patch features (B, P, width)."""
        towers = zip((self.featurizer, self.fused_featurizer), pixels.chunk(2, dim=1), strict=True)
        features = [tower.get_intermediate_layers(x, n=[depth_of(tower) - 1])[0] for tower, x in towers]
        return torch.cat(features, dim=-1)


class Projector(nn.Module):
    """Patch features to the width of the language model's embeddings, three layers with GELU between."""

    def __init__(self, vision_width: int, text_width: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(vision_width, 4 * vision_width)
        self.fc2 = nn.Linear(4 * vision_width, text_width)
        self.fc3 = nn.Linear(text_width, text_width)

    def forward(self, features: Tensor) -> Tensor:
        """Map (B, P, vision width) to (B, P, text width)."""
        return self.fc3(F.gelu(self.fc2(F.gelu(self.fc1(features)))))


class OpenVLANetwork(nn.Module):
    """Its parameters have the names of the published safetensors but for timm's `gamma` (see checkpoint.py)."""

    def __init__(self, architecture: Architecture, attention: str = "sdpa") -> None:
        super().__init__()
        text = {
            k: v for k, v in architecture.text_config.items() if k not in ("model_type", "torch_dtype", "dtype")
        }
        config = LlamaConfig(**text)
        config._attn_implementation = attention
        self.vision_backbone = VisionTower(architecture)
        self.projector = Projector(self.vision_backbone.width, config.hidden_size)
        self.language_model = LlamaForCausalLM(config)

    @property
    def text_width(self) -> int:
        """Width of the language model's hidden states."""
        return self.language_model.config.hidden_size

    @property
    def bos_token_id(self) -> int:
        """The token that every sequence begins with."""
        token = self.language_model.config.bos_token_id
        return 1 if token is None else token

    def embed_tokens(self, tokens: Tensor) -> Tensor:
        """Tokens (B, L) to embeddings (B, L, text width)."""
        return self.language_model.model.embed_tokens(tokens)

    def enable_gradient_checkpointing(self) -> None:
        """Keep fewer activations for the backward pass, see `recomputing`."""
        for tower in (self.vision_backbone.featurizer, self.vision_backbone.fused_featurizer):
            tower.set_grad_checkpointing(True)
        self.language_model.gradient_checkpointing_enable({"use_reentrant": False})
        # That also makes the embeddings take part in the gradient, which only reentrant checkpoints need.
        self.language_model.disable_input_require_grads()

    @contextmanager
    def recomputing(self) -> Generator[None]:
        """Inside, Llama's layers do what `enable_gradient_checkpointing` asked for, in evaluation mode too.

        They do it only in training mode, which changes nothing else in a layer: dropout is in its parts.
        """
        layers = self.language_model.model.layers
        modes = [layer.training for layer in layers]
        for layer in layers:
            layer.training = True
        try:
            yield
        finally:
            for layer, mode in zip(layers, modes, strict=True):
                layer.training = mode


class ValueHead(nn.Module):
    """The critic: three layers with GELU between, float32, zero at the start.

    Args:
        width: of the hidden state where the first action token is predicted.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        first, second = VALUE_WIDTHS
        out = nn.Linear(second, 1)
        nn.init.zeros_(out.weight)
        nn.init.zeros_(out.bias)
        self.layers = nn.Sequential(nn.Linear(width, first), nn.GELU(), nn.Linear(first, second), nn.GELU(), out)

    def forward(self, hidden: Tensor) -> Tensor:
        """Hidden states (B, width) to values (B,)."""
        return self.layers(hidden.float()).squeeze(-1)


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
