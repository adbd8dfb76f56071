import numpy as np
import pytest

from cronos_lerobot.agents.decisions import Decision
from cronos_lerobot.agents.ppo.rollout_buffer import RolloutBuffer

U, N = 5, 3


def filled(rows=U):
    buffer = RolloutBuffer(U, N)
    for t in range(rows):
        ids = np.arange(N) + 10 * t
        columns = {
            "observation.images.front": np.broadcast_to(ids[:, None, None, None], (N, 2, 2, 3)).astype(np.uint8),
            "observation.state": ids[:, None].astype(np.float32),
        }
        sample = Decision(
            np.zeros((N, 7), np.float32), np.tile(ids[:, None], 7), ids.astype(np.float32), 2.0 * ids, columns
        )
        boundary = np.full(N, t == rows - 1)
        buffer.add(sample, [f"task {i}" for i in ids], ids / 2, boundary, ids + 100.0)
    return buffer


@pytest.mark.parametrize("batch_size", [1, 4, 15, 100])
def test_every_transition_once_per_epoch(batch_size):
    buffer = filled()
    rng = np.random.default_rng(0)
    epochs = [
        np.concatenate([minibatch.indices for minibatch in buffer.minibatches(batch_size, rng)]) for _ in range(2)
    ]
    for indices in epochs:
        assert sorted(indices) == list(range(U * N))
    assert not np.array_equal(*epochs)


def test_columns_of_a_minibatch_belong_together():
    buffer = filled()
    buffer.compute_advantages(0.99, 0.95)
    for minibatch in buffer.minibatches(4, np.random.default_rng(1)):
        row, stream = np.divmod(minibatch.indices, N)
        ids = 10 * row + stream
        assert minibatch.observation["observation.images.front"].dtype == np.uint8
        np.testing.assert_array_equal(minibatch.observation["observation.images.front"][:, 0, 0, 0], ids)
        np.testing.assert_array_equal(minibatch.observation["observation.state"][:, 0], ids)
        np.testing.assert_array_equal(minibatch.trace[:, 3], ids)
        np.testing.assert_array_equal(minibatch.log_prob, ids)
        np.testing.assert_array_equal(minibatch.value, 2 * ids)
        assert minibatch.instructions == [f"task {i}" for i in ids]
        np.testing.assert_allclose(minibatch.return_, minibatch.advantage + minibatch.value, rtol=1e-6)
        np.testing.assert_array_equal(minibatch.advantage, buffer.advantages[row, stream])


@pytest.mark.parametrize(("max_bytes", "pieces"), [(10**6, 1), (1, 2 * N), (16 * 2 * N, 1), (16 * 2 * N - 1, 2)])
def test_a_minibatch_is_split_by_the_size_of_its_observations(max_bytes, pieces):
    """2 N observations of a number, four bytes, and a picture of 2 x 2 x 3."""
    buffer = filled(rows=2)
    (whole,) = buffer.minibatches(100, np.random.default_rng(0))
    parts = whole.split(max_bytes)
    assert len(parts) == pieces
    assert max(len(part.indices) for part in parts) - min(len(part.indices) for part in parts) <= 1
    assert [text for part in parts for text in part.instructions] == whole.instructions
    for name in ("indices", "trace", "log_prob", "value", "advantage", "return_"):
        joined = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(joined, getattr(whole, name))
    states = [part.observation["observation.state"] for part in parts]
    np.testing.assert_array_equal(np.concatenate(states), whole.observation["observation.state"])


@pytest.mark.parametrize("batch_size", [1, 2 * N, 100])
def test_observations_are_mapped_once_and_may_stand_in_for_the_stored_ones(batch_size):
    buffer = filled(rows=4)
    seen = []

    def number(columns, instructions):
        ids = columns["observation.state"][:, 0]
        assert instructions == [f"task {int(i)}" for i in ids]
        seen.extend(ids)
        return {"negative": -ids}

    mapped = buffer.map_observations(batch_size, number)
    expected = [10 * row + stream for row in range(4) for stream in range(N)]
    assert seen == expected
    assert mapped["negative"].shape == (4, N)
    for minibatch in buffer.minibatches(5, np.random.default_rng(1), mapped):
        assert list(minibatch.observation) == ["negative"]
        np.testing.assert_array_equal(minibatch.observation["negative"], -np.array(expected)[minibatch.indices])
