"""Instructions as text."""

import torch
from lerobot_policy_pocketvla.networks import TextEncoder
from lerobot_policy_pocketvla.tokenizer import token_ids, words_of

OBJECTS = ("ketchup bottle", "kitchen shovel", "toy bear", "plastic bottle", "carrot", "banana", "7up can")
RECEPTACLES = ("yellow plate", "cloth", "carpet", "newspaper", "table")


def test_case_punctuation_and_spacing_carry_no_meaning():
    assert words_of("  Put the CARROT, on the plate!") == ["put", "the", "carrot", "on", "the", "plate"]
    assert token_ids("Put it on.", 4096) == token_ids("put  it on", 4096)


def test_ids_are_the_same_in_every_process():
    # Frozen: a checkpoint's embeddings belong to these identifiers.
    assert token_ids("put the", 4096) == (908, 634, 2085)


def test_the_benchmark_words_do_not_collide():
    words = {word for name in OBJECTS + RECEPTACLES for word in name.split()} | {"put", "the", "on"}
    ids = {token_ids(word, 4096) for word in words}
    assert len(ids) == len(words)


def test_order_matters_and_texts_without_words_are_accepted():
    encoder = TextEncoder(4096, 64)
    task = encoder(["put cloth on bear", "put bear on cloth", "put cloth on bear", "?!"])
    assert len(task.unique) == 3
    a, b, c, empty = task.spread(task.unique)
    assert torch.equal(a, c)
    assert not torch.allclose(a, b)
    assert torch.isfinite(empty).all()


def test_a_text_is_encoded_alike_alone_and_beside_longer_ones():
    encoder = TextEncoder(4096, 64)
    alone = encoder(["put it"]).unique[0]
    beside = encoder(["put the very long named thing on the table over there", "put it"]).unique[1]
    torch.testing.assert_close(alone, beside)
