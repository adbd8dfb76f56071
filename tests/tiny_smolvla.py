"""A SmolVLM of two narrow layers on disk, for SmolVLA with `vlm_model_name` a folder: nothing is downloaded."""

import sys
import types
from importlib.machinery import ModuleSpec
from pathlib import Path

WORDS = ("<pad>", "<unk>", "<end_of_utterance>", "<fake_token_around_image>", "<global-img>", "<image>")
NAMES = ("end_of_utterance_token", "fake_image_token", "global_image_token", "image_token")


def pretend_num2words() -> None:
    """SmolVLM's processor does not load without this package, and calls it for videos only."""
    module = types.ModuleType("num2words")
    module.__spec__ = ModuleSpec("num2words", None)
    module.num2words = str  # ty: ignore[unresolved-attribute]
    sys.modules.setdefault("num2words", module)


def save_tiny_smolvlm(folder: Path) -> None:
    """Config and processor of an untrained SmolVLM, as `load_vlm_weights=False` reads them."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast, SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor
    from transformers.models.smolvlm.video_processing_smolvlm import SmolVLMVideoProcessor

    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(WORDS)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer = PreTrainedTokenizerFast(
        tokenizer_object=words, pad_token="<pad>", unk_token="<unk>",
        extra_special_tokens=dict(zip(NAMES, WORDS[2:], strict=True)),
    )  # fmt: skip
    layers = {"num_attention_heads": 2, "intermediate_size": 32}
    vision = {"hidden_size": 16, "num_hidden_layers": 1, "image_size": 32, "patch_size": 8}
    text = {"hidden_size": 32, "num_hidden_layers": 2, "num_key_value_heads": 1, "head_dim": 16}
    text |= {"model_type": "llama", "vocab_size": len(WORDS), "pad_token_id": 0}
    config = SmolVLMConfig(
        image_token_id=WORDS.index("<image>"), pad_token_id=0, scale_factor=2,
        vision_config=vision | layers, text_config=text | layers,
    )  # fmt: skip
    config.save_pretrained(folder)
    SmolVLMProcessor(SmolVLMImageProcessor(), tokenizer, SmolVLMVideoProcessor()).save_pretrained(folder)
