"""An instruction as the tokens of OpenVLA's prompt."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from tokenizers import Tokenizer

TOKENIZER = "tokenizer.json"
SPACE = "▁"
"""The token of a lone space; the published checkpoints were trained with one before the first action token."""


def prompt_of(instruction: str) -> str:
    """The question that OpenVLA was trained with."""
    return f"In: What action should the robot take to {instruction.lower()}?\nOut:"


class PromptTokenizer:
    """Tokenises instructions with a checkpoint's tokenizer.json.

    Args:
        folder: of the checkpoint.
        bos_token_id: first token of every prompt.

    Raises:
        ValueError: the tokenizer has no token for a lone space.
    """

    def __init__(self, folder: Path, bos_token_id: int) -> None:
        self.path = folder / TOKENIZER
        self._json = self.path.read_bytes()
        self._tokenizer = Tokenizer.from_file(str(self.path))
        self.bos_token_id = bos_token_id
        space = self._tokenizer.token_to_id(SPACE)
        if space is None:
            raise ValueError(f"{self.path} has no token {SPACE!r}; it is not Llama's tokenizer.")
        self.space_token_id: int = space
        self._ids = lru_cache(maxsize=4096)(self._tokenize)

    def __call__(self, instruction: str) -> tuple[int, ...]:
        """Return the tokens of the prompt, the first of which is the beginning of the sequence."""
        return self._ids(instruction)

    def save(self, folder: Path) -> None:
        """Write tokenizer.json into `folder`."""
        if (folder / TOKENIZER).resolve() != self.path.resolve():
            (folder / TOKENIZER).write_bytes(self._json)

    def _tokenize(self, instruction: str) -> tuple[int, ...]:
        ids = self._tokenizer.encode(prompt_of(instruction)).ids
        if ids[:1] != [self.bos_token_id]:
            ids = [self.bos_token_id, *ids]
        if ids[-1] != self.space_token_id:
            ids = [*ids, self.space_token_id]
        return tuple(ids)
