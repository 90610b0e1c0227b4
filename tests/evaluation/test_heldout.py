import numpy as np
import pytest

from ebarf_ns.evaluation.heldout import Prediction, prediction

RANDOM = np.random.default_rng(0)
BRIGHTER, DARKER = RANDOM.integers(0, 6, (2, 5000)).astype(float)
COUNT = np.maximum(BRIGHTER + DARKER, 1)
TRUE_CHANGE = 0.21 * BRIGHTER - 0.34 * DARKER


RATIO = 0.21 / 0.34


def predicted(change: np.ndarray) -> Prediction:
    return prediction(change, BRIGHTER - DARKER, BRIGHTER + DARKER, COUNT, RATIO)


def test_perfect_render_leaves_nothing_whatever_its_scale_and_tells_the_thresholds():
    unexplained, on, off = predicted(3 * TRUE_CHANGE)
    assert unexplained == pytest.approx(0, abs=1e-12)
    assert on == pytest.approx(3 * 0.21) and off == pytest.approx(3 * 0.34)


def test_ignorant_contrary_or_dark_render_leaves_everything():
    assert predicted(RANDOM.standard_normal(5000)).unexplained > 0.99
    assert predicted(0.25 * (DARKER - BRIGHTER)).unexplained == 1
    assert predicted(np.zeros(5000)).unexplained == 1


def test_thresholds_are_found_beneath_noise():
    _, on, off = predicted(TRUE_CHANGE + 0.01 * RANDOM.standard_normal(5000))
    assert on == pytest.approx(0.21, rel=0.02) and off == pytest.approx(0.34, rel=0.02)


def test_half_right_is_in_between():
    assert 0.1 < predicted(TRUE_CHANGE + 0.8 * RANDOM.standard_normal(5000)).unexplained < 0.6


def test_nothing_reported_is_no_number():
    unexplained, on, off = prediction(TRUE_CHANGE, np.zeros(5000), COUNT, COUNT, 1.0)
    assert np.isnan(unexplained) and on is None and off is None


def test_thresholds_that_the_pairs_cannot_tell_apart_are_none():
    assert prediction(np.ones(5), np.ones(5), np.ones(5), np.ones(5), 1.0) == (pytest.approx(0), None, None)
    assert prediction(np.array([0.3]), np.zeros(1), np.full(1, 2.0), np.full(1, 2.0), 1.0)[1:] == (None, None)


def test_a_ramp_that_brightens_all_the_way_earns_nothing():
    """A one-way pan with ratio 0.6: pixels see stripes come and go, and a render that also brightens all the time."""
    random = np.random.default_rng(0)
    ratio, duration = 0.6, random.uniform(0.1, 1, 4000)
    # In the same time, as many thresholds up as down, each of its own size; events come at random moments.
    up, down = random.poisson(9 * duration / ratio**0.5), random.poisson(9 * duration * ratio**0.5)
    columns = (up - down.astype(float), up + down.astype(float), np.maximum(up + down, 1.0))
    true = ratio**0.5 * up - down / ratio**0.5
    # Brightness that rises at the rate by which thresholds taken as equal would not cancel.
    ramp = np.mean(up - down) / np.mean(duration) * duration
    scores = [prediction(change, *columns, ratio).unexplained for change in (true, ramp + 0.3 * true, ramp, -true)]
    assert scores[0] < 0.01 and scores[0] < scores[1] < scores[2] <= scores[3] == 1 and scores[2] > 0.95
    # Thresholds fitted to it would have taken much of the ramp for granted.
    fitted = prediction(ramp + 0.3 * true, *columns, 1.6).unexplained
    assert fitted < scores[1]
