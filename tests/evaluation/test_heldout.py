import numpy as np
import pytest

from ebarf_ns.evaluation.heldout import unexplained_share

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
