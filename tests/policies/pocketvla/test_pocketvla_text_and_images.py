"""Instructions as text, and images as tensors."""

import torch
from lerobot_policy_pocketvla.images import random_shift, spatial_softmax, to_signed_unit_range
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


def test_bytes_and_floats_give_the_same_image():
    images = torch.arange(256, dtype=torch.uint8).repeat(3, 1)[None, :, None, :]
    from_bytes = to_signed_unit_range(images, torch.float32)
    from_floats = to_signed_unit_range(images.float() / 255, torch.float32)
    torch.testing.assert_close(from_bytes, from_floats, atol=1e-6, rtol=0)
    assert from_bytes.min().item() == -1.0
    assert from_bytes.max().item() == 1.0
    half = to_signed_unit_range(images, torch.bfloat16).float()
    torch.testing.assert_close(half, from_bytes, atol=2**-9, rtol=0)


def test_spatial_softmax_finds_a_peak():
    maps = torch.zeros(1, 2, 5, 9)
    maps[0, 0, 0, 8] = 100.0  # top right
    maps[0, 1, 2, 4] = 100.0  # centre
    torch.testing.assert_close(spatial_softmax(maps), torch.tensor([[1.0, 0.0, -1.0, 0.0]]), atol=1e-5, rtol=0)


def test_random_shift_moves_whole_images_by_at_most_the_limit():
    image = torch.zeros(1, 3, 16, 16, dtype=torch.uint8)
    image[:, :, 8, 8] = 200
    shifted = random_shift(image.expand(64, 3, 16, 16), 2, torch.Generator().manual_seed(0))
    assert shifted.shape == (64, 3, 16, 16)
    where = (shifted[:, 0] == 200).nonzero()
    assert len(where) == 64
    assert torch.equal(shifted[:, 0], shifted[:, 2])
    offsets = {tuple(row) for row in (where[:, 1:] - 8).tolist()}
    assert max(abs(o) for pair in offsets for o in pair) == 2
    assert len(offsets) > 10
    assert random_shift(image, 0) is image
