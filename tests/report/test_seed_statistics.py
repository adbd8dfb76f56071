"""Intervals of rates and gains are those of the books, and end where rates and gains do."""

import pytest

from cronos_lerobot.report.statistics import ChainRate, Gain, Rate, SeedRate, newcombe_interval, sum_rates


def test_newcombe_interval_of_the_paper():
    """Newcombe 1998, Table II, example (a), method 10: 56/70 against 48/80."""
    low, high = newcombe_interval(before=Rate(48, 80), after=Rate(56, 70))
    assert (round(low, 4), round(high, 4)) == (0.0524, 0.3339)


def test_newcombe_interval_at_the_edge():
    """0/10 against 10/10 ends at 1 and stays clear of 0."""
    low, high = newcombe_interval(before=Rate(0, 10), after=Rate(10, 10))
    # Wilson of 10/10 is [10 / (10 + 1.96^2), 1] = [0.7225, 1], so 1 - sqrt(2) * 0.2775.
    assert (round(low, 3), high) == (0.608, 1.0)


def test_gain_of_nothing_covers_zero():
    gain = Gain(Rate(30, 64), Rate(30, 64))
    assert gain.value == 0
    assert gain.interval[0] < 0 < gain.interval[1]
    assert gain.interval[0] == pytest.approx(-gain.interval[1])


def test_seeds_that_are_all_alike_do_not_say_that_every_training_is():
    # Wilson's of 9 of 10, (.9 + z^2 / 20 -+ z sqrt(.09 / 10 + z^2 / 400)) / (1 + z^2 / 10): the second evaluation
    # is of the same episodes.
    assert SeedRate.of([Rate(9, 10)] * 2).interval == pytest.approx((0.5958, 0.9821), abs=1e-4)
    # A seed without an episode says nothing.
    assert SeedRate.of([Rate(9, 10), Rate(0, 0)]).interval == Rate(9, 10).interval


def test_a_rate_of_seeds_with_other_numbers_of_episodes_lies_in_its_interval():
    # 15 of 30; 1 - .5 * 10 = -4 and 14 - .5 * 20 = 4: 12.706 * sqrt(2 * 32) / 30 is more than a half to each side.
    assert SeedRate.of([Rate(1, 10), Rate(14, 20)]).interval == (0.0, 1.0)
    # 30 of 60; -1, 2, -1: 4.3027 * sqrt(1.5 * 6) / 60.
    rate = SeedRate.of([Rate(4, 10), Rate(12, 20), Rate(14, 30)])
    assert rate.value == 0.5
    assert rate.interval == pytest.approx((0.2849, 0.7151), abs=1e-4)
    # 915 of 1030: the mean of .9, .5, .5 and .5 lies far below.
    low, high = SeedRate.of([Rate(900, 1000), *[Rate(5, 10)] * 3]).interval
    assert low < 915 / 1030 < high
    # Some that are all alike: the largest one's.
    assert SeedRate.of([Rate(1, 2), Rate(50, 100)]).interval == Rate(50, 100).interval


def test_chains_from_one_configuration_go_together():
    one = ChainRate.of([True, True, False, False], range(4))
    # One from each configuration: Wilson's of 2 of 4, .5 -+ z sqrt(.25 / 4 + z^2 / 64) / (1 + z^2 / 4).
    assert one.interval == pytest.approx((0.1500, 0.8500), abs=1e-4)
    # A second ordering that comes out alike. 2, 2, 0, 0 of the four vary by 4 / 3 * 4 / 8^2 = 1 / 12, where eight
    # single chains would by .25 / 8: they say what 3 do, less by (1.96 / 3.182)^2 of four: Wilson's of 1.138.
    both = sum_rates([one, one])
    assert (both.successes, both.n) == (4, 8)
    assert both.interval == pytest.approx((0.0608, 0.9392), abs=1e-3)
    assert SeedRate.of([both]).interval == both.interval
    # More chains than configurations begin anew with the first.
    assert ChainRate.of([True, True, False, False] * 2, range(4)) == both


def test_gains_that_are_all_alike_have_an_interval_of_their_evaluations():
    before, after = SeedRate.of([Rate(3, 10)] * 2), SeedRate.of([Rate(8, 10)] * 2)
    assert Gain(before, after).interval == newcombe_interval(Rate(3, 10), Rate(8, 10))


def test_intervals_over_seeds_end_where_rates_and_gains_do():
    """t with two degrees of freedom is 4.3027."""
    # Mean .9, standard deviation .1: .9 +- 4.3027 * .1 / sqrt(3) = .9 +- .2484.
    after = SeedRate.of([Rate(8, 10), Rate(9, 10), Rate(10, 10)])
    assert after.interval == (pytest.approx(0.6516, abs=1e-4), 1.0)
    # Gains .7, .8 and .9, as far apart: .8 +- .2484.
    before = SeedRate.of([Rate(1, 10)] * 3)
    assert Gain(before, after).interval == (pytest.approx(0.5516, abs=1e-4), 1.0)
    assert Gain(after, before).interval == (-1.0, pytest.approx(-0.5516, abs=1e-4))
