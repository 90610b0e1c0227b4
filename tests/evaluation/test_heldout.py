import numpy as np
import pytest

from ebarf_ns.evaluation.heldout import implied_thresholds, unexplained_share

RANDOM = np.random.default_rng(0)
REPORTED = RANDOM.choice([-0.25, 0.25, 0.5], 5000)
COUNT = RANDOM.integers(1, 5, 5000).astype(float)


def test_perfect_render_leaves_nothing_whatever_its_scale():
    assert unexplained_share(3 * REPORTED, REPORTED, COUNT) == pytest.approx(0, abs=1e-12)


def test_ignorant_contrary_or_dark_render_leaves_everything():
    assert unexplained_share(RANDOM.standard_normal(5000), REPORTED, COUNT) > 0.99
    assert unexplained_share(-REPORTED, REPORTED, COUNT) == 1
    assert unexplained_share(np.zeros(5000), REPORTED, COUNT) == 1


def test_half_right_is_in_between():
    assert 0.1 < unexplained_share(REPORTED + 0.2 * RANDOM.standard_normal(5000), REPORTED, COUNT) < 0.6


def test_nothing_reported_is_no_number():
    assert np.isnan(unexplained_share(REPORTED, np.zeros(5000), COUNT))


def test_implied_thresholds_are_those_of_the_sensor():
    random = np.random.default_rng(0)
    brighter, darker = random.integers(0, 6, (2, 500)).astype(float)
    count, some = brighter + darker, brighter + darker > 0
    change = 0.21 * brighter - 0.34 * darker + 0.01 * random.standard_normal(500)
    on, off = implied_thresholds(change[some], (brighter - darker)[some], count[some])
    assert on == pytest.approx(0.21, rel=0.02) and off == pytest.approx(0.34, rel=0.02)


def test_thresholds_that_the_pairs_cannot_tell_apart_are_none():
    assert implied_thresholds(np.ones(5), np.ones(5), np.ones(5)) == (None, None)
    assert implied_thresholds(np.array([0.3]), np.zeros(1), np.full(1, 2.0)) == (None, None)
