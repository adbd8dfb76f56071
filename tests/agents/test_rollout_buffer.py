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
