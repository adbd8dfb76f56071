"""A tiny random OpenVLA in the published format, built from timm and transformers alone.

Nothing of the plugin is used here: the tests compare it with these modules, called one after the other.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import timm
import torch
from safetensors.torch import save_file
from tokenizers import AddedToken, Tokenizer, decoders, models, normalizers, processors, trainers
from torch import nn
from transformers import LlamaConfig, LlamaForCausalLM

TIMM_MODEL_IDS = ["test_vit2", "test_vit3"]
IMAGE_SIZE, NUM_PATCHES = 64, 16
VOCABULARY, PADDING_ROWS, BINS = 640, 64, 256
TEXT_CONFIG = {
    "model_type": "llama", "torch_dtype": "bfloat16", "vocab_size": VOCABULARY + PADDING_ROWS,
    "pad_token_id": VOCABULARY, "hidden_size": 64, "intermediate_size": 96, "num_hidden_layers": 2,
    "num_attention_heads": 4, "max_position_embeddings": 128,
}  # fmt: skip
BRIDGE = {
    "q01": [-0.02872725307941437, -0.04170349963009357, -0.026093858778476715, -0.08092105075716972,
            -0.09288699507713317, -0.20718276381492615, 0.0],
    "q99": [0.028309678435325586, 0.040855254605412394, 0.040161586627364146, 0.08192047759890528,
            0.07792850524187081, 0.20382574498653397, 1.0],
    "mask": [True] * 6 + [False],
    "mean": [0.0] * 7, "std": [1.0] * 7, "min": [-1.0] * 7, "max": [1.0] * 7,
}  # fmt: skip
OTHER = {"q01": [-1.0] * 7, "q99": [3.0] * 7, "mask": [True] * 7}
MEANS = [[0.484375, 0.455078125, 0.40625], [0.5, 0.5, 0.5]]
STDS = [[0.228515625, 0.2236328125, 0.224609375], [0.5, 0.5, 0.5]]


@dataclass
class Parts:
    """The modules of the checkpoint, whole, as the published model has them."""

    featurizer: nn.Module
    fused_featurizer: nn.Module
    projector: nn.ModuleDict
    language_model: LlamaForCausalLM

    def published_tensors(self) -> dict[str, torch.Tensor]:
        tensors = {}
        for name, module in (
            ("vision_backbone.featurizer", self.featurizer),
            ("vision_backbone.fused_featurizer", self.fused_featurizer),
            ("projector", self.projector),
            ("language_model", self.language_model),
        ):
            for key, value in module.state_dict().items():
                tensors[f"{name}.{key}".replace(".gamma", ".scale_factor")] = value.contiguous()
        return tensors


def make_parts(seed: int = 0) -> Parts:
    torch.manual_seed(seed)
    towers = [timm.create_model(name, num_classes=0, img_size=IMAGE_SIZE) for name in TIMM_MODEL_IDS]
    vision_width = sum(tower.embed_dim for tower in towers)
    text_width = TEXT_CONFIG["hidden_size"]
    projector = nn.ModuleDict(
        {
            "fc1": nn.Linear(vision_width, 4 * vision_width),
            "fc2": nn.Linear(4 * vision_width, text_width),
            "fc3": nn.Linear(text_width, text_width),
        }
    )
    fields = {k: v for k, v in TEXT_CONFIG.items() if k not in ("model_type", "torch_dtype")}
    parts = Parts(*towers, projector, LlamaForCausalLM(LlamaConfig(**fields)))
    with torch.no_grad():
        for module in (*towers, projector, parts.language_model):
            module.eval()
            for name, parameter in module.named_parameters():
                # As they come, layer scales are nearly 0 and all logits nearly the same.
                spread = 0.3 if "gamma" in name or name.endswith(("bias", "lm_head.weight")) else 0.08
                parameter.add_(spread * torch.randn_like(parameter))
    return parts


def make_tokenizer() -> Tokenizer:
    """Llama's kind of tokenizer: byte-level fallback, spaces as a letter, a beginning-of-sequence token."""
    tokenizer = Tokenizer(models.BPE(unk_token="<unk>", fuse_unk=True, byte_fallback=True))
    tokenizer.normalizer = normalizers.Sequence([normalizers.Prepend("▁"), normalizers.Replace(" ", "▁")])
    tokenizer.decoder = decoders.Sequence([decoders.Replace("▁", " "), decoders.ByteFallback(), decoders.Fuse()])
    special = ["<unk>", "<s>", "</s>"] + [f"<0x{i:02X}>" for i in range(256)]
    trainer = trainers.BpeTrainer(vocab_size=VOCABULARY - BINS, special_tokens=special, show_progress=False)
    corpus = ["In: What action should the robot take to put the ketchup bottle on the yellow plate?\nOut:",
              "kitchen shovel cloth table toy cube basket abcdefghijklmnopqrstuvwxyz ▁"]  # fmt: skip
    tokenizer.train_from_iterator(corpus, trainer)
    tokenizer.add_tokens([AddedToken("<PAD>", special=True)])
    tokenizer.post_processor = processors.TemplateProcessing(
        single="<s> $A", pair="<s> $A <s> $B", special_tokens=[("<s>", 1)]
    )
    return tokenizer


def write_checkpoint(folder: Path, parts: Parts, shards: int = 2, **changes) -> Path:
    """Write config.json, preprocessor_config.json, sharded safetensors with their index, tokenizer.json."""
    folder.mkdir(parents=True, exist_ok=True)
    config = {
        "model_type": "openvla", "architectures": ["OpenVLAForActionPrediction"],
        "arch_specifier": "no-align+fused-gelu-mlp", "vision_backbone_id": "dinosiglip-vit-so-224px",
        "llm_backbone_id": "llama2-7b-pure", "image_resize_strategy": "resize-naive",
        "image_sizes": [IMAGE_SIZE, IMAGE_SIZE], "timm_model_ids": TIMM_MODEL_IDS,
        "timm_override_act_layers": [None, None], "use_fused_vision_backbone": True, "n_action_bins": BINS,
        "pad_token_id": VOCABULARY, "pad_to_multiple_of": PADDING_ROWS, "text_config": TEXT_CONFIG,
        "norm_stats": {"bridge_orig": {"action": BRIDGE, "num_trajectories": 1}, "other": {"action": OTHER}},
    } | changes  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config))
    preprocessor = {
        "image_resize_strategy": "resize-naive", "interpolations": ["bicubic"] * 2, "means": MEANS, "stds": STDS,
        "tvf_do_letterbox": False, "tvf_letterbox_fill": None,
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(preprocessor))
    make_tokenizer().save(str(folder / "tokenizer.json"))
    tensors = parts.published_tensors()
    names, weight_map = list(tensors), {}
    for i in range(shards):
        file = f"model-{i + 1:05d}-of-{shards:05d}.safetensors"
        shard = {name: tensors[name].clone() for name in names[i::shards]}
        save_file(shard, folder / file, metadata={"format": "pt"})
        weight_map |= dict.fromkeys(shard, file)
    index = {"metadata": {}, "weight_map": weight_map}
    (folder / "model.safetensors.index.json").write_text(json.dumps(index))
    return folder


@torch.no_grad()
def reference_logits(parts: Parts, pixels: torch.Tensor, prompt: list[int], actions: list[int]) -> torch.Tensor:
    """Logits (len(actions) + 1, V) of one observation, by the published recipe, without cache, batch or padding.

    pixels is (6, size, size); `prompt` starts with <s>; `actions` are the action tokens so far.
    """
    features = []
    for tower, image in ((parts.featurizer, pixels[:3]), (parts.fused_featurizer, pixels[3:])):
        features.append(tower.get_intermediate_layers(image[None], n={len(tower.blocks) - 2})[0])
    x = torch.cat(features, dim=2)
    gelu = nn.functional.gelu
    projected = parts.projector["fc3"](gelu(parts.projector["fc2"](gelu(parts.projector["fc1"](x)))))
    embed = parts.language_model.get_input_embeddings()
    text = embed(torch.tensor([prompt + actions]))
    sequence = torch.cat([text[:, :1], projected, text[:, 1:]], dim=1)
    return parts.language_model(inputs_embeds=sequence).logits[0, -len(actions) - 1 :]
