"""pi0 and pi0.5 of two narrow layers: LeRobot's own classes, whose sizes are no setting of theirs."""

from contextlib import ExitStack, contextmanager
from pathlib import Path
from unittest.mock import patch

TOKENIZER = "google/paligemma-3b-pt-224"
"""What LeRobot's processors of pi0 and pi0.5 fetch from the Hub."""
WORDS = 64


@contextmanager
def tiny_gemma():
    """Inside, LeRobot makes and loads pi0 and pi0.5 with few and narrow layers."""
    from lerobot.policies.pi0 import modeling_pi0
    from lerobot.policies.pi05 import modeling_pi05

    with ExitStack() as stack:
        for module in (modeling_pi0, modeling_pi05):
            # Eight heads are written into LeRobot's layers.
            sizes = {"gemma_2b": (32, 2, 32, 8, 1, 8), "gemma_300m": (16, 2, 16, 8, 1, 8)}
            replaced = {
                "get_gemma_config": lambda variant, m=module, s=sizes: m.GemmaConfig(*s[variant]),
                "PaliGemmaForConditionalGenerationWithPiGemma": _shrinking(
                    module.PaliGemmaForConditionalGenerationWithPiGemma
                ),
                "PiGemmaForCausalLM": _shrinking(module.PiGemmaForCausalLM),
            }
            for name, value in replaced.items():
                stack.enter_context(patch.object(module, name, value))
        yield


def _shrinking(model):
    def make(config):
        text = getattr(config, "text_config", config)
        text.vocab_size = WORDS
        if vision := getattr(config, "vision_config", None):
            vision.hidden_size, vision.num_hidden_layers, vision.num_attention_heads = 16, 1, 2
            vision.intermediate_size, vision.projection_dim = 16, text.hidden_size
        return model(config=config)

    return make


def save_tiny_tokenizer(folder: Path) -> None:
    """A tokenizer that knows numbers, in place of PaliGemma's."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import PreTrainedTokenizerFast

    known = ["<pad>", "<unk>", *map(str, range(WORDS - 2))]
    words = Tokenizer(models.WordLevel({word: i for i, word in enumerate(known)}, unk_token="<unk>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    PreTrainedTokenizerFast(tokenizer_object=words, pad_token="<pad>", unk_token="<unk>").save_pretrained(folder)


@contextmanager
def tokenizer_from(folder: Path):
    """Inside, LeRobot's processors of pi0 and pi0.5 take the tokenizer of a folder for PaliGemma's."""
    from lerobot.processor import tokenizer_processor
    from transformers import AutoTokenizer

    class Local:
        @staticmethod
        def from_pretrained(name):
            return AutoTokenizer.from_pretrained(folder if name == TOKENIZER else name)

    with patch.object(tokenizer_processor, "AutoTokenizer", Local):
        yield


def use_tokenizer(checkpoint: Path, tokenizer: Path) -> None:
    """Write a tokenizer's folder into the processor of a checkpoint, as one does without the Hub."""
    file = checkpoint / "policy_preprocessor.json"
    file.write_text(file.read_text().replace(TOKENIZER, str(tokenizer)))
