"""GAE by hand: gamma = 0.5, lambda = 0.5, so that every number is a short binary fraction."""

import numpy as np

from cronos_lerobot.agents.ppo.gae import compute_gae


def gae(rewards, values, boundaries, bootstrap):
    columns = [np.array(c, dtype)[:, None] for c, dtype in ((rewards, float), (values, float), (boundaries, bool))]
    advantages, returns = compute_gae(*columns, np.array(bootstrap, float)[:, None], gamma=0.5, gae_lambda=0.5)
    assert advantages.dtype == returns.dtype == np.float32
    np.testing.assert_allclose(returns, advantages + columns[1], atol=1e-6)
    return advantages[:, 0].tolist()


def test_only_an_update_boundary_at_the_end():
    # delta_2 = 1 + .5 * 8 - 2 = 3; delta_1 = 0 + .5 * 2 - 4 = -3; delta_0 = 1 + .5 * 4 - 2 = 1
    # A_2 = 3; A_1 = -3 + .25 * 3 = -2.25; A_0 = 1 + .25 * -2.25 = .4375
    assert gae([1, 0, 1], [2, 4, 2], [0, 0, 1], [-9, -9, 8]) == [0.4375, -2.25, 3]


def test_a_cut_keeps_the_other_side_out():
    # Row 1 ends a segment; its bootstrap 6 is the value before the switch or reset, row 2 is another world.
    # delta_2 = 1 + .5 * 8 - 2 = 3; delta_1 = 0 + .5 * 6 - 4 = -1; delta_0 = 1 + .5 * 4 - 2 = 1
    # A_1 = -1, without .25 * A_2; A_0 = 1 + .25 * -1 = .75
    assert gae([1, 0, 1], [2, 4, 2], [0, 1, 1], [-9, 6, 8]) == [0.75, -1, 3]


def test_divergence_bootstraps_from_the_value_before_it():
    # There is no o_2 after row 1: its bootstrap is V(o_1) = 4 itself.
    # delta_1 = 0 + .5 * 4 - 4 = -2; A_0 = 1 + .25 * -2 = .5
    assert gae([1, 0, 1], [2, 4, 2], [0, 1, 1], [-9, 4, 8]) == [0.5, -2, 3]


def test_streams_do_not_mix():
    rewards, values = np.array([[1.0, 0], [0, 0]]), np.zeros((2, 2))
    boundaries = np.array([[False, True], [True, True]])
    advantages, _ = compute_gae(rewards, values, boundaries, np.zeros((2, 2)), 0.5, 0.5)
    assert advantages.tolist() == [[1, 0], [0, 0]]


def test_a_decision_of_several_steps_discounts_what_follows_by_its_length():
    # Decisions of 2, 1 and 3 steps; their rewards are sums already. gamma^d = .25, .5, .125.
    # delta_2 = 1 + .125 * 8 - 2 = 0; delta_1 = 0 + .5 * 2 - 4 = -3; delta_0 = 1 + .25 * 4 - 2 = 0
    # A_2 = 0; A_1 = -3 + .5 * .5 * 0 = -3; A_0 = 0 + .25 * .5 * -3 = -.375
    columns = (np.array(c, float)[:, None] for c in ([1, 0, 1], [2, 4, 2], [0, 0, 1], [-9, -9, 8], [2, 1, 3]))
    rewards, values, boundaries, bootstrap, durations = columns
    advantages, _ = compute_gae(rewards, values, boundaries.astype(bool), bootstrap, 0.5, 0.5, durations)
    assert advantages[:, 0].tolist() == [-0.375, -3, 0]
