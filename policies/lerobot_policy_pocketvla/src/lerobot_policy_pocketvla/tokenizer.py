"""Instruction text to word identifiers, without a vocabulary file."""

import re
import zlib
from functools import lru_cache
from itertools import pairwise

WORD = re.compile(r"\w+")


def words_of(text: str) -> list[str]:
    """Split into lower-case words; case, punctuation and spacing carry no meaning."""
    return WORD.findall(text.lower())


@lru_cache(maxsize=4096)
def token_ids(text: str, vocabulary_size: int) -> tuple[int, ...]:
    """Hash the words and the pairs of neighbouring words of `text` into `vocabulary_size` buckets.

    Pairs carry the word order ("bottle on" against "on bottle"). Any wording maps to something, so no
    instruction can fail; the hash is CRC-32, the same on every machine and in every Python process.

    Returns:
        One identifier in [1, vocabulary_size) per word and per pair; 0 is the padding, and all there is
        for a text without a word.
    """
    words = words_of(text)
    pairs = [f"{first} {second}" for first, second in pairwise(words)]
    buckets = vocabulary_size - 1
    ids = tuple(1 + zlib.crc32(item.encode()) % buckets for item in words + pairs)
    return ids or (0,)
