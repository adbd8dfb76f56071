"""Areas, intervals and tests, by hand or by scipy."""

from math import isnan, sqrt

import numpy as np
import pytest
from scipy.stats import binomtest, permutation_test

from cronos_lerobot.statistics import (
    interpolate,
    performance_gap,
    sign_flip_p,
    success_at,
    summarise,
    wilson_interval,
)


def test_gap_is_the_area_above_the_curve_over_its_length():
    # Trapezoids: 10 * (0.8 + 0.6) / 2 + 30 * (0.6 + 0.2) / 2 = 7 + 12.
    assert performance_gap([0, 10, 40], [0.2, 0.4, 0.8]) == pytest.approx(19 / 40)
    # Nothing is assumed of what came before the first evaluation.
    assert performance_gap([10, 20], [0.5, 0.5]) == 0.5
    assert performance_gap([0, 5], [1, 1]) == 0
    assert performance_gap([0, 5], [0, 0]) == 1


def test_several_evaluations_at_one_number_of_interventions():
    # From 0 to 10 the curve goes from the last evaluation at 0 (.4) to the first at 10 (.6), from 10 to 20 from
    # the last at 10 (.8) to .9: 10 * (.6 + .4) / 2 + 10 * (.2 + .1) / 2.
    x, y = [0, 0, 10, 10, 20], [0.2, 0.4, 0.6, 0.8, 0.9]
    assert performance_gap(x, y) == pytest.approx((5 + 1.5) / 20)
    assert interpolate(x, y, [0, 5, 10, 15, 20]).tolist() == pytest.approx([0.4, 0.5, 0.8, 0.85, 0.9])


def test_run_that_was_never_reset_has_no_reset_efficiency():
    assert isnan(performance_gap([0, 0, 0], [0.2, 0.3, 0.4]))
    assert success_at([0, 0, 0], [0.2, 0.3, 0.4], 0) == 0.4


def test_gap_up_to_a_shared_end():
    x, y = [0, 10, 20], [0.0, 0.5, 1.0]
    # Up to 15 it ends at .75: 10 * (1 + .5) / 2 + 5 * (.5 + .25) / 2.
    assert performance_gap(x, y, up_to=15) == pytest.approx((7.5 + 1.875) / 15)
    assert performance_gap(x, y, up_to=20) == performance_gap(x, y)
    assert isnan(performance_gap(x, y, up_to=21))
    # What follows at the end itself is beyond it.
    assert performance_gap([0, 10, 10, 20], [0.0, 0.5, 0.9, 1.0], up_to=10) == pytest.approx(0.75)


def test_success_is_never_extrapolated():
    x, y = [100, 200], [0.2, 0.6]
    assert success_at(x, y, 125) == pytest.approx(0.3)
    assert isnan(success_at(x, y, 99))
    assert isnan(success_at(x, y, 201))
    assert (success_at(x, y, 100), success_at(x, y, 200)) == (0.2, 0.6)


def test_interval_of_three_seeds_by_a_table_of_students_t():
    # Squares of the deviations: .09 + .01 + .16, over n - 1 = 2. t with 2 degrees of freedom is 4.303 at 97.5 %.
    summary = summarise([0.2, 0.4, 0.9])
    assert (summary.mean, summary.std) == (pytest.approx(0.5), pytest.approx(sqrt(0.26 / 2)))
    half = 4.303 * sqrt(0.13 / 3)
    assert summary.ci95 == (pytest.approx(0.5 - half, abs=1e-4), pytest.approx(0.5 + half, abs=1e-4))


@pytest.mark.parametrize("num_seeds", [3, 5])
def test_interval_over_few_seeds_covers_what_it_says(num_seeds):
    runs = np.random.default_rng(0).normal(0.8, 0.05, (2000, num_seeds))
    intervals = [summarise(run).ci95 for run in runs]
    covered = sum(low <= 0.8 <= high for low, high in intervals)
    # .95 of 2000, within four standard errors of sqrt(2000 * .95 * .05) = 9.7.
    assert abs(covered - 1900) < 40


def test_one_seed_has_no_spread_and_a_missing_one_no_mean():
    one = summarise([0.5])
    assert (one.mean, one.std, one.ci95) == (0.5, None, None)
    assert isnan(summarise([]).mean)
    assert isnan(summarise([0.5, float("nan")]).mean)


def test_interval_over_seeds_needs_three_that_differ_and_ends_where_rates_do():
    two, alike, wide = (summarise(values, (0, 1)) for values in ([0.2, 0.4], [0.5] * 3, [0.1, 0.5, 0.9]))
    assert (two.mean, two.ci95) == (pytest.approx(0.3), None)
    assert (alike.mean, alike.std, alike.ci95) == (0.5, 0.0, None)
    # .5 +- 4.303 * .4 / sqrt(3).
    assert wide.ci95 == (0.0, 1.0)


def test_with_successes_it_is_mcnemars_exact_test():
    # 9 pairs differ, 8 of them one way: 2 (C(9, 8) + C(9, 9)) / 2^9 = 20 / 512.
    assert sign_flip_p([0] * 20 + [1] * 8 + [-1]) == 20 / 512
    assert sign_flip_p([1] * 8 + [-1]) == pytest.approx(binomtest(8, 9).pvalue)
    assert sign_flip_p([1, -1, 0]) == sign_flip_p([0, 0]) == 1


def test_with_chain_lengths_every_way_to_flip_signs_counts():
    # 3, 1, 1: sums 5, 3, 3, 1 and their negatives; 2 of 8 are as far from 0 as 5, 6 of 8 as far as 3.
    assert sign_flip_p([3, 1, 1]) == 2 / 8
    assert sign_flip_p([3, 1, -1]) == 6 / 8
    differences = np.random.default_rng(0).integers(-4, 5, 12)
    theirs = permutation_test((differences,), np.sum, permutation_type="samples", n_resamples=np.inf)
    assert sign_flip_p(differences) == pytest.approx(theirs.pvalue)


def test_wilson_interval_of_known_counts():
    # Published values: 0/10 -> (0, .2775), 9/10 -> (.5958, .9821), 5/10 -> (.2366, .7634).
    assert wilson_interval(0, 10) == pytest.approx((0, 0.2775), abs=1e-4)
    assert wilson_interval(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)
    assert wilson_interval(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    # 10 of 10: low = 1 / (1 + z^2 / 10), z = 1.96.
    assert wilson_interval(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)
