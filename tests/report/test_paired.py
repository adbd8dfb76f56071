"""Differences of two policies on the same episodes, with numbers worked out by hand or published."""

import numpy as np
import pytest
from scipy.stats import ttest_1samp, ttest_ind, ttest_rel

from cronos_lerobot.report.paired import (
    Pairs,
    compare_policies,
    compare_trainings,
    holm,
    newcombe_paired_interval,
    pair,
)
from cronos_lerobot.statistics import effective_trials


@pytest.mark.parametrize(
    ("counts", "ends"),
    [
        # Newcombe 1998, Table II; method 10.
        ((36, 12, 2, 0), (0.0569, 0.3404)),
        ((20, 12, 2, 16), (0.0562, 0.3292)),
        # Fagerland, Lydersen and Laake 2014, airway hyper-responsiveness.
        ((1, 1, 7, 12), (-0.507, -0.026)),
    ],
)
def test_newcombes_interval_is_the_published_one(counts, ends):
    assert newcombe_paired_interval(*counts) == pytest.approx(ends, abs=6e-5 if ends[0] > 0 else 6e-4)


def one_each(counts):
    """Pairs of one episode from each configuration, by (both, only B, only A, neither)."""
    a = np.repeat([1, 0, 1, 0], counts)
    b = np.repeat([1, 1, 0, 0], counts)
    return Pairs(a[None], b[None], np.arange(len(a)))


def test_one_episode_from_each_configuration():
    found = compare_policies(one_each((20, 12, 2, 16)))
    assert found.value == 0.2
    assert found.ci95 == pytest.approx((0.0562, 0.3292), abs=6e-5)
    # 14 pairs differ, 12 of them one way: 2 (1 + 14 + 91) / 2^14.
    assert found.p == 212 / 16384
    # The differences have variance 14/50 - .2^2 = .24, by n - 1 .24 x 50/49: (2.01 + .85) .4949 / sqrt(50).
    assert found.detectable == pytest.approx(0.2001, abs=1e-4)


def test_no_pair_differs():
    found = compare_policies(one_each((30, 0, 0, 20)))
    assert (found.value, found.p, found.detectable) == (0, 1, None)
    # Not certain to be alike; if A always fails where B succeeds, 0 of 50 has Wilson's [0, .0713].
    low, high = found.ci95
    assert low == pytest.approx(-high)
    assert 0 < high < 0.0713


def test_episodes_of_a_configuration_that_go_together_count_as_one():
    # Ten configurations of four episodes that come out alike: as ten pairs, of which 8 and 2 differ.
    d = np.repeat([1] * 8 + [-1] * 2, 4)
    pairs = Pairs((d < 0).astype(int)[None], (d > 0).astype(int)[None], np.repeat(np.arange(10), 4))
    found = compare_policies(pairs)
    assert found.value == pytest.approx(0.6)
    # 2 (1 + 10 + 45) / 2^10, by configuration; by episode it would be 2e-5.
    assert found.p == 112 / 1024
    # The variance of the mean is that of ten numbers, .64 x 10/9 / 10, that of 40 alone .64 / 40: design effect
    # 40/9, so 9 pairs, and with (1.960 / 2.262)^2 for ten clusters 6.757.
    assert effective_trials(d.astype(float), pairs.clusters) == pytest.approx(6.757, abs=1e-3)
    theirs = ttest_1samp([1] * 8 + [-1] * 2, 0)
    assert found.detectable == pytest.approx((2.2622 + 0.8834) * theirs._standard_error, abs=1e-3)


def test_chains_that_all_have_the_same_length_say_nothing_of_others():
    """As the lengths of chains of which none came to a task, which are no rates."""
    none = np.zeros((1, 8), int)
    found = compare_policies(Pairs(none, none, np.arange(8), are_chains=True))
    assert (found.value, found.ci95) == (0, None)
    assert compare_policies(Pairs(none, none, np.arange(8))).ci95 is not None


def test_chains_are_compared_by_their_lengths():
    a, b = np.array([[4, 1, 0, 2, 3, 1]]), np.array([[4, 2, 1, 4, 2, 4]])
    found = compare_policies(Pairs(a, b, np.arange(6), are_chains=True))
    # Differences 0, 1, 1, 2, -1, 3: mean 1, standard deviation sqrt(2).
    assert found.value == 1
    half = 2.5706 * np.sqrt(2 / 6)
    assert found.ci95 == pytest.approx((1 - half, 1 + half), abs=1e-4)
    # Of the 32 ways to sign 1, 1, 2, 1, 3, with sum 6 of 8: |sum| = 8 has 2, |sum| = 6 has 2 x 3 (a 1 is flipped).
    assert found.p == 8 / 32
    low, high = ttest_1samp((b - a)[0], 0).confidence_interval()
    assert found.ci95 == pytest.approx((low, high))


def test_trainings_where_configurations_make_no_difference_are_welchs_t_test():
    # Every configuration has the same number in a policy: nothing is between them.
    a, b = np.array([2, 3, 7]), np.array([6, 9, 9])
    sides = [np.repeat(side[:, None], 8, axis=1) for side in (a, b)]
    found = compare_trainings(Pairs(*sides, np.arange(8)))
    assert found is not None
    theirs = ttest_ind(b, a, equal_var=False)
    assert found.value == 4
    # Variances 7 and 3 of 3 trainings: (7 + 3) / 3; t = 4 / sqrt(10 / 3) = 2.19.
    assert found.p == pytest.approx(theirs.pvalue)
    assert found.ci95 == pytest.approx(tuple(theirs.confidence_interval()))


def test_trainings_that_do_alike_vary_by_configuration():
    # Three trainings each, all of A's alike and all of B's: only the configurations differ.
    d = np.array([1, 1, 0, 1, -1, 1])
    a = np.repeat((d < 0).astype(int)[None], 3, axis=0)
    b = np.repeat((d > 0).astype(int)[None], 3, axis=0)
    found = compare_trainings(Pairs(a, b, np.arange(6)))
    assert found is not None
    # Nothing is between trainings, alone or in some of the configurations: a paired t-test of the configurations.
    theirs = ttest_rel(b[0], a[0])
    assert found.p == pytest.approx(theirs.pvalue)
    assert found.ci95 == pytest.approx(tuple(theirs.confidence_interval()))


def test_variances_of_a_table_by_hand():
    # Three trainings (rows) in two configurations, against a policy that does nothing.
    after = np.array([[2, 0], [2, 1], [2, 2]])
    found = compare_trainings(Pairs(np.zeros((1, 2), int), after, np.arange(2)))
    assert found is not None
    # Of the mean, between the means of rows, 1, 1.5, 2, it is .25 / 3; between those of columns, 2 and 1, .5 / 2.
    # Cells less both are +-.5 in two rows: 4 x .25 over 2 degrees of freedom, of the mean of six .5 / 6. In all
    # 1/12 + 1/4 - 1/12, with (1/4)^2 / ((1/12)^2 / 2 + (1/6)^2) = 2 degrees of freedom.
    half = 4.3027 * np.sqrt(1 / 4)
    assert found.ci95 == pytest.approx((1.5 - half, 1.5 + half), abs=1e-4)


def test_trainings_that_differ_less_than_chance_are_no_surer_than_these_policies():
    # All trainings have 2 of 3; all columns have 2 of 3, too, and only the interaction varies.
    after = np.array([[1, 0, 1, 1], [0, 1, 1, 1], [1, 1, 0, 1]])
    found = compare_trainings(Pairs(np.zeros((1, 4), int), after, np.arange(4)))
    # Columns 2/3, 2/3, 2/3, 1: a t-test of the columns.
    theirs = ttest_1samp([2 / 3, 2 / 3, 2 / 3, 1], 0)
    assert found.p == pytest.approx(theirs.pvalue)
    assert found.ci95 == pytest.approx(tuple(theirs.confidence_interval()))


def test_a_base_that_all_trainings_begin_with_is_one_policy():
    """Whether it is taken from each of them or stands against all: it does not average out over them."""
    rng = np.random.default_rng(2)
    base, after = rng.integers(0, 2, (1, 64)), rng.integers(0, 2, (3, 64))
    scenes = np.arange(16).repeat(4)
    gained = compare_trainings(Pairs(np.zeros_like(base), after - base, scenes))
    against = compare_trainings(Pairs(base, after, scenes))
    assert gained is not None
    assert against is not None
    assert gained.ci95 == pytest.approx(against.ci95)


def test_one_training_each_says_nothing_of_trainings_and_a_fixed_base_is_none():
    lengths = np.array([[1, 0, 1, 1], [0, 0, 1, 1], [1, 1, 1, 1]])
    assert compare_trainings(Pairs(lengths[:1], lengths[1:2], np.arange(4))) is None
    against_base = compare_trainings(Pairs(lengths[:1], lengths, np.arange(4)))
    assert against_base is not None
    assert against_base.method.startswith("t-interval and p by training and configuration (1 against 3 trainings")


# Each way to train is better in some configurations and worse in others, and trainings differ; or one of them.
@pytest.mark.parametrize(("by_configuration", "by_training"), [(0.5, 0.5), (1.5, 0.0)])
def test_intervals_cover_the_difference_as_often_as_they_say(by_configuration, by_training):
    """Trainings and configurations of their own effects: 3 against 3, 24 configurations of 4 episodes."""
    rng, covered, runs = np.random.default_rng(5), 0, 300
    true = _true_difference(1 + by_configuration**2 + by_training**2)
    for _ in range(runs):
        scenes, episodes = rng.normal(0, 1, 24).repeat(4), (3, 96)
        sides = []
        for better in (0.0, 0.5):
            own = rng.normal(0, by_training, (3, 1)) + rng.normal(0, by_configuration, 24).repeat(4)
            p = 1 / (1 + np.exp(-(better + scenes + own)))
            sides.append((rng.random(episodes) < p).astype(int))
        found = compare_trainings(Pairs(*sides, np.arange(24).repeat(4)))
        assert found is not None
        assert found.ci95 is not None
        covered += found.ci95[0] < true < found.ci95[1]
    # Of 300 with 95 %, 3 standard deviations below 285 are 273.7.
    assert covered >= 274


def test_two_trainings_say_nothing_of_others():
    one, two, three = (np.eye(n, 4, dtype=int) for n in (1, 2, 3))
    assert compare_trainings(Pairs(one, two, np.arange(4))) is None
    assert compare_trainings(Pairs(three, two, np.arange(4))) is None
    assert compare_trainings(Pairs(three, one, np.arange(4))) is not None


def test_level_of_three_trainings_against_one_policy():
    """Nothing differs: the one succeeds as often as the others do on average, in each of 64 configurations."""
    rng, rejected, runs = np.random.default_rng(9), 0, 300
    scenes = np.arange(64).repeat(4)
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    for _ in range(runs):
        easy = rng.normal(0, 1, 64)[scenes]
        average = _logistic(easy + 0.5 * nodes[:, None]).T @ weights / weights.sum()
        rates = _logistic(easy + rng.normal(0, 0.5, (3, 1)))
        sides = [(rng.random(p.shape) < p).astype(int) for p in (average[None], rates)]
        rejected += compare_trainings(Pairs(*sides, scenes)).p < 0.05
    # Of 300 with 5 %, 3 standard deviations above 15 are 26.3; of three trainings the level is some .07: 34.
    assert rejected <= 34


def test_where_nothing_varies_the_configurations_decide():
    worst, best = np.zeros((3, 64), int), np.ones((3, 64), int)
    found = compare_trainings(Pairs(worst, best, np.arange(64)))
    # 64 configurations, all one way.
    assert (found.value, found.ci95, found.p) == (1, None, 2 / 2**64)
    assert compare_trainings(Pairs(best, best, np.arange(64))).p == 1


def _logistic(x):
    return 1 / (1 + np.exp(-x))


def _true_difference(variance):
    x = np.random.default_rng(1).normal(0, np.sqrt(variance), 400_000)
    return float(np.mean(1 / (1 + np.exp(-(x + 0.5)))) - np.mean(1 / (1 + np.exp(-x))))


def test_holms_adjustment():
    # Smallest first: 3 x .01, 2 x .02, 1 x .04, never falling.
    assert holm([0.04, 0.01, 0.02]) == pytest.approx([0.04, 0.03, 0.04])
    assert holm([0.6, 0.5]) == [1, 1]


def test_pairs_are_the_episodes_that_all_ran_clustered_by_configuration():
    # Columns seed, number, configuration, length.
    a = np.array([[5, 1, 9, 1], [5, 0, 9, 0], [5, 0, 7, 1]])
    b = np.array([[5, 0, 7, 0], [5, 0, 9, 1], [5, 1, 9, 1], [6, 1, 9, 1]])
    pairs, numbers = pair([a], [b])
    assert numbers.tolist() == [0, 0, 1]
    assert (pairs.a.tolist(), pairs.b.tolist(), pairs.clusters.tolist()) == ([[1, 0, 1]], [[0, 1, 1]], [0, 1, 1])
    with pytest.raises(ValueError, match="same episodes"):
        pair([np.concatenate([a, a])], [b])
    with pytest.raises(ValueError, match="sampling seed"):
        pair([a], [b[3:]])


def test_episodes_of_one_configuration_are_clustered_by_repetition():
    """64 times four tasks from one start, each with other draws: of one cluster nothing would be known."""
    a, b = (
        np.array([[seed, task, 0, int(seed % 4 == 0 or always)] for task in range(4) for seed in range(64)])
        for always in (False, True)
    )
    found = compare_policies(pair([a], [b])[0])
    assert found.value == 0.75
    # 48 of 64 repetitions differ, all one way, and in all four tasks.
    assert found.p == pytest.approx(2 / 2**48)
    assert found.method.endswith("over 64 repetitions")
