import pytest
from lerobot_env_cronos.statistics import wilson_interval


def test_wilson_interval_of_known_counts():
    # Published values: 0/10 -> (0, .2775), 9/10 -> (.5958, .9821), 5/10 -> (.2366, .7634).
    assert wilson_interval(0, 10) == pytest.approx((0, 0.2775), abs=1e-4)
    assert wilson_interval(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)
    assert wilson_interval(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    # 10 of 10: low = 1 / (1 + z^2 / 10), z = 1.96.
    assert wilson_interval(10, 10) == pytest.approx((0.7225, 1.0), abs=1e-4)


@pytest.mark.parametrize(("successes", "n"), [(0, 0), (3, 2), (-1, 2)])
def test_impossible_counts_are_refused(successes, n):
    with pytest.raises(ValueError, match=f"successes={successes}, n={n}"):
        wilson_interval(successes, n)
