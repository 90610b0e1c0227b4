import numpy as np
import pytest

from ebarf_ns.simulation.sensor import EventSensor


def watch(curves: np.ndarray, t_us: np.ndarray, on: float = 0.2, off: float = 0.3):
    sensor = EventSensor(on, off, width=curves.shape[1])
    for t, sample in zip(t_us.tolist(), curves, strict=True):
        sensor.see(t, sample)
    return sensor.recording()


def test_events_sum_up_to_the_brightness_between_any_two():
    t_us = np.arange(0, 1_000_000, 1000)
    phase = np.linspace(0, 6, 7)
    curves = 2 * np.sin(2 * np.pi * t_us[:, None] * 1e-6 + phase)
    events = watch(curves, t_us)
    assert (np.diff(events.t_us) >= 0).all()
    for pixel in range(7):
        mine = events.x == pixel
        times, polarity = events.t_us[mine], events.polarity[mine]
        at = np.interp(times, t_us, curves[:, pixel])
        reported = np.where(polarity > 0, 0.2, -0.3)
        # Times are rounded to a microsecond, in which this curve moves by 1.3e-5.
        assert np.allclose(np.diff(at), reported[1:], atol=5e-5) and len(times) > 25


def test_a_ramp_gives_evenly_spaced_events_between_two_samples():
    events = watch(np.array([[0.0], [2.0]]), np.array([0, 10_000]))
    gaps = np.diff(events.t_us)
    assert (events.polarity == 1).all() and gaps.min() >= 999 and gaps.max() <= 1001 and len(events) in (9, 10, 11)


@pytest.mark.parametrize("level", [0.0, -50.0, 1e6])
def test_still_light_is_silent(level: float):
    steady = np.full((50, 4), level)
    steady[-1] += 0.5
    events = watch(steady, np.arange(50) * 100)
    assert (events.t_us >= 4800).all()
