from dataclasses import replace

import numpy as np
import pytest
from scipy.special import expi

from ebarf_ns.simulation.sensor import Crossings, EventSensor, SensorModel

CLEAN = SensorModel(threshold_on=0.2, threshold_off=0.3)


def watch(curves: np.ndarray, t_us: np.ndarray, model: SensorModel = CLEAN) -> Crossings:
    """Events of pixels whose log brightness is given per column."""
    sensor = EventSensor(model, float(t_us[-1]), 0, curves[0])
    pixel = np.repeat(np.arange(curves.shape[1]), len(t_us) - 1)
    return sensor.see(pixel, np.tile(t_us[1:].astype(float), curves.shape[1]), curves[1:].T.ravel())


def ramps(pixels: int, height: float = 20.0, seconds: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    t_us = np.arange(0, seconds * 1e6 + 1, 1000)
    return np.repeat((height * t_us / t_us[-1])[:, None], pixels, axis=1), t_us


def test_events_sum_up_to_the_brightness_between_any_two():
    t_us = np.arange(0, 1_000_000, 1000)
    phase = np.linspace(0, 6, 7)
    curves = 2 * np.sin(2 * np.pi * t_us[:, None] * 1e-6 + phase)
    events = watch(curves, t_us)
    for pixel in range(7):
        mine = events.pixel == pixel
        times, polarity = events.t_us[mine], events.polarity[mine]
        assert (np.diff(times) >= 0).all()
        at = np.interp(times, t_us, curves[:, pixel])
        reported = np.where(polarity > 0, 0.2, -0.3)
        assert np.allclose(np.diff(at), reported[1:], atol=1e-9) and len(times) > 25


def test_a_ramp_gives_evenly_spaced_events_between_two_samples():
    events = watch(np.array([[0.0], [2.0]]), np.array([0, 10_000]))
    assert (events.polarity == 1).all() and np.allclose(np.diff(events.t_us), 1000) and len(events.pixel) in (9, 10, 11)


@pytest.mark.parametrize("level", [0.0, -50.0, 1e6])
def test_still_light_is_silent(level: float):
    steady = np.full((50, 4), level)
    steady[-1] += 0.5
    assert (watch(steady, np.arange(50) * 100).t_us >= 4800).all()


def test_the_refractory_period_resets_the_reference_level():
    curves, t_us = ramps(3)
    events = watch(curves, t_us, replace(CLEAN, refractory_us=5000))
    # The ramp takes 10 ms per threshold, starting at the end of the refractory period.
    for pixel in range(3):
        assert np.allclose(np.diff(events.t_us[events.pixel == pixel]), 15_000)


def test_leak_makes_positive_events_in_constant_light():
    events = watch(np.zeros((101, 50)), np.arange(101) * 100_000.0, replace(CLEAN, leak_hz=0.5))
    assert (events.polarity == 1).all() and len(events.pixel) == pytest.approx(0.5 * 10 * 50, abs=50)


def test_noise_comes_at_its_rate_and_hot_pixels_at_theirs():
    model = replace(CLEAN, shot_noise_hz=2.0, hot_pixels=3, hot_pixel_hz=500.0)
    events = watch(np.zeros((101, 1000)), np.arange(101) * 10_000.0, model)
    counts = np.bincount(events.pixel, minlength=1000)
    hot = counts > 250
    assert hot.sum() == 3 and counts[hot].mean() == pytest.approx(500, rel=0.15)
    assert counts[~hot].mean() == pytest.approx(2.0, rel=0.15)
    assert (events.polarity > 0).mean() == pytest.approx(0.5, abs=0.05) and np.isnan(events.before).all()


def test_a_noise_event_resets_the_reference_level():
    curves, t_us = ramps(400, height=0.15)
    # Never a whole threshold at once, but occasionally a crossing from a level that noise has shifted.
    quiet, noisy = (watch(curves, t_us, replace(CLEAN, shot_noise_hz=hz)) for hz in (0.0, 50.0))
    reported = ~np.isnan(noisy.before)
    assert 0 < reported.sum() < len(quiet.pixel)


def test_threshold_mismatch_has_the_given_size():
    curves, t_us = ramps(2000)
    events = watch(curves, t_us, replace(CLEAN, threshold_mismatch=0.05))
    thresholds = 20.0 / np.bincount(events.pixel, minlength=2000)
    assert thresholds.std() / thresholds.mean() == pytest.approx(0.05, rel=0.1)
    assert thresholds.mean() == pytest.approx(0.2, rel=0.02)


def test_threshold_drift_has_the_given_size():
    t_us = np.arange(0, 1_000_001, 1000.0)
    sensor = EventSensor(replace(CLEAN, threshold_drift=0.5), 1e6, 0, np.zeros(1))
    chunks = [sensor.see(np.zeros(1, int), t_us[k : k + 1], 20e-6 * t_us[k : k + 1]) for k in range(1, len(t_us))]
    gaps = np.diff(np.concatenate([chunk.t_us for chunk in chunks]))
    assert gaps[0] == pytest.approx(0.75 * 10_000, rel=0.02) and gaps[-1] == pytest.approx(1.25 * 10_000, rel=0.02)


def test_limited_bandwidth_answers_a_step_as_a_low_pass_does():
    t_us = np.r_[0.0, 1.0, np.arange(20.0, 20_001, 20)]
    curve = np.where(t_us > 0, 2.0, 0.0)[:, None]
    model = replace(CLEAN, cutoff_hz=100.0)
    level = EventSensor(model, t_us[-1], 0, curve[0]).level[0]
    expected = [level + 0.2 * k for k in range(1, 20) if 0 < level + 0.2 * k < 1.98]
    lag_us = 1e6 / (2 * np.pi * 100)
    events = watch(curve, t_us, model)
    assert np.allclose(events.t_us[: len(expected)], -lag_us * np.log(1 - np.array(expected) / 2), atol=5)


def lagging_events_us(intensity: float, model: SensorModel, step_us: float = 20.0) -> np.ndarray:
    """Events of a pixel whose log brightness rises by 2 within a microsecond, to the given intensity."""
    t_us = np.r_[0.0, 1.0, np.arange(step_us, 150_001, step_us)]
    return watch(np.where(t_us > 0, 0.0, -2.0)[:, None] + np.log(intensity), t_us, model).t_us


FOLLOWS_LIGHT = replace(CLEAN, cutoff_hz=100.0, cutoff_reference=0.5)


@pytest.mark.parametrize("intensity", [0.25, 1.0])
def test_bandwidth_that_follows_the_light_answers_a_step_as_a_low_pass_does(intensity: float):
    # The first level lies within a threshold of the start.
    level = EventSensor(FOLLOWS_LIGHT, 1.0, 0, np.zeros(1)).level[0]
    expected = np.array([level + 0.2 * k for k in range(1, 20) if 0 < level + 0.2 * k < 2])
    lag_us = 1e6 / (2 * np.pi * 100 * intensity / 0.5)
    events_us = lagging_events_us(intensity, FOLLOWS_LIGHT)
    assert np.allclose(events_us, -lag_us * np.log(1 - expected / 2), atol=1, rtol=0)


@pytest.mark.parametrize(
    ("intensity", "share"), [(1e-3, 0.1), (0.03, 0.1), (0.1, 0.2), (0.5, 1.0), (1.4, 2.8), (2.0, 3.0), (1e3, 3.0)]
)
def test_dark_pixels_lag_more_than_bright_ones_within_bounds(intensity: float, share: float):
    reference_us = lagging_events_us(0.5, replace(FOLLOWS_LIGHT, cutoff_reference=0.0))
    # From the middle of the step.
    lag_us, expected_us = lagging_events_us(intensity, FOLLOWS_LIGHT) - 0.5, (reference_us - 0.5) / share
    assert len(lag_us) > 5 and np.allclose(lag_us, expected_us, atol=0.5, rtol=1e-3)


def test_bandwidth_without_a_reference_is_the_same_at_any_light():
    model = replace(CLEAN, cutoff_hz=100.0, cutoff_reference=0.0)
    assert model == replace(CLEAN, cutoff_hz=100.0)
    assert np.allclose(lagging_events_us(1e-3, model), lagging_events_us(1e3, model), atol=1e-6)
    # A reference without a bandwidth has no effect either.
    clean = lagging_events_us(1e-3, CLEAN)
    assert np.array_equal(clean, lagging_events_us(1e-3, replace(CLEAN, cutoff_reference=0.5)))


def test_bandwidth_grows_with_the_light_while_it_rises():
    slope, start = 40.0, 0.1
    t_us = np.arange(0, 50_001, 200.0)
    events = watch(slope * 1e-6 * t_us[:, None] + np.log(start), t_us, replace(FOLLOWS_LIGHT, cutoff_reference=1.0))
    # The lag d of the pixel solves d' = slope - bandwidth * exp(slope * t) * d while the bounds are inactive.
    first, now = (2 * np.pi * 100 * start / slope * np.exp(slope * 1e-6 * at) for at in (0.0, events.t_us))
    behind = np.exp(-now) * (expi(now) - expi(first))
    inside = start * np.exp(slope * 1e-6 * events.t_us) < 2.8
    seen = (slope * 1e-6 * events.t_us - behind)[inside]
    # Using the light at either end of a step instead of the midpoint would give an error of 1e-3.
    level = EventSensor(CLEAN, 1.0, 0, np.zeros(1)).level[0]
    assert len(seen) > 5 and np.allclose(seen, level + 0.2 * np.arange(1, len(seen) + 1), atol=2e-5, rtol=0)


def test_bandwidth_follows_the_light_and_not_the_leak():
    t_us = np.arange(0, 1_000_001, 1000.0)
    leaking = replace(CLEAN, cutoff_hz=20.0, leak_hz=20.0)
    same, follows = (watch(np.zeros((len(t_us), 5)), t_us, replace(leaking, cutoff_reference=r)) for r in (0.0, 1.0))
    assert len(same.t_us) > 90 and np.allclose(same.t_us, follows.t_us, atol=1e-3, rtol=0)


def test_timestamp_jitter_has_the_given_size_and_stays_within_the_recording():
    sensor = EventSensor(replace(CLEAN, jitter_us=30.0), 1e6, 0, np.zeros(1))
    t_us = np.linspace(0, 1e6, 20_000)
    jittered = sensor.jitter(t_us)
    assert jittered.dtype == np.int64 and jittered.min() >= 0 and jittered.max() <= 1_000_000
    assert (jittered - t_us)[100:-100].std() == pytest.approx(30, rel=0.05)


def test_drifting_thresholds_make_no_events_in_constant_light():
    still = np.full((200, 2000), -1.0)
    grows = watch(still, np.arange(200) * 5_000.0, replace(CLEAN, threshold_drift=1.0))
    assert len(grows.pixel) == 0
