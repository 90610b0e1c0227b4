"""The recorder against a closed-form solution: a camera that slides past stripes on a wall."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from ebarf_ns.geometry.cameras import Camera
from ebarf_ns.simulation.record import record
from ebarf_ns.simulation.sensor import EventSensor, SensorModel
from ebarf_ns.simulation.view import View

SENSOR = SensorModel(threshold_on=0.2, threshold_off=0.3)
END_US = 1_000_000


@dataclass(frozen=True)
class Stripes:
    """A wall at z = 1 whose log radiance is a sinusoid of x, or black and white."""

    amplitude: float = 1.0
    cycles_per_m: float = 8.0
    sharp: bool = False

    def log_radiance(self, x: np.ndarray) -> np.ndarray:
        wave = np.sin(2 * np.pi * self.cycles_per_m * x)
        return self.amplitude * (np.sign(wave) if self.sharp else wave)

    def cast(self, origin: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        distance = (1 - origin[:, 2]) / direction[:, 2]
        return np.exp(self.log_radiance(origin[:, 0] + distance * direction[:, 0])), distance


@dataclass(frozen=True)
class Slide:
    speed_m_s: float = 0.5

    def position(self, t_us: np.ndarray) -> np.ndarray:
        return np.asarray(t_us)[:, None] * 1e-6 * [self.speed_m_s, 0, 0]

    def rotation(self, t_us: np.ndarray) -> np.ndarray:
        return np.tile(np.eye(3), (len(t_us), 1, 1))


STRIPES = Stripes()


def view_of(stripes: Stripes = STRIPES, speed_m_s: float = 0.5, width: int = 60, rays_per_pixel: int = 1) -> View:
    camera = Camera("pinhole", width, 2, 80.0, 80.0, (width - 1) / 2, 0.5)
    return View(stripes, Slide(speed_m_s), camera, rays_per_pixel)


def expected_events(stripes: Stripes, x0: float, speed_m_s: float, level: float) -> list[tuple[float, int]]:
    """Times [us] and polarities from inverting the sinusoid between successive extrema."""
    rate = 2 * np.pi * stripes.cycles_per_m
    phase0, phase_end = rate * x0, rate * (x0 + speed_m_s * END_US * 1e-6)
    turns = np.arange(np.ceil(phase0 / np.pi - 0.5), phase_end / np.pi - 0.5) * np.pi + np.pi / 2
    events = []
    for start, end in zip(np.r_[phase0, turns], np.r_[turns, phase_end], strict=True):
        until = stripes.amplitude * np.sin(end)
        rising = until > stripes.amplitude * np.sin(start)
        step = SENSOR.threshold_on if rising else -SENSOR.threshold_off
        middle = np.round(((start + end) / 2) / np.pi) * np.pi
        while (level + step <= until) if rising else (level + step >= until):
            level += step
            angle = np.arcsin(level / stripes.amplitude)
            phase = middle + (angle if rising else -angle)
            events.append(((phase - phase0) / rate / speed_m_s * 1e6, 1 if rising else -1))
    return events


@pytest.mark.parametrize("speed_m_s", [0.05, 0.5, 5.0])
def test_counts_and_times_of_a_moving_sinusoid_match_the_closed_form(speed_m_s: float):
    stripes = Stripes()
    view = view_of(stripes, speed_m_s)
    events = record(view, SENSOR, END_US, 0)
    x0 = (np.arange(60) - 29.5) / 80
    levels = EventSensor(SENSOR, END_US, 0, np.tile(stripes.log_radiance(x0), 2)).level
    assert len(events) > 100
    for pixel in range(120):
        expected = expected_events(stripes, x0[pixel % 60], speed_m_s, levels[pixel])
        mine = (events.x == pixel % 60) & (events.y == pixel // 60)
        assert [polarity for _, polarity in expected] == events.polarity[mine].tolist()
        assert np.allclose(events.t_us[mine], [t_us for t_us, _ in expected], atol=1.0, rtol=0)


def test_a_sharp_edge_gives_all_its_events_when_it_passes():
    view = view_of(Stripes(sharp=True, cycles_per_m=2.0))
    events = record(view, SENSOR, END_US, 0)
    edges_us = (np.arange(-2, 5) / 4 - (events.x[:, None] - 29.5) / 80) / 0.5 * 1e6
    assert (np.abs(edges_us - events.t_us[:, None]).min(axis=1) <= 1.5).all()
    # Each crossing changes log brightness by 2.
    assert len(events) > 500 and np.bincount(events.x).min() >= 2 * (2 / 0.3 - 1)


def test_several_rays_per_pixel_soften_an_edge():
    hard, soft = (
        record(view_of(Stripes(sharp=True, cycles_per_m=0.5), rays_per_pixel=rays), SENSOR, END_US, 0)
        for rays in (1, 4)
    )
    spread = [np.mean([np.ptp(events.t_us[events.x == x]) for x in range(25, 30)]) for events in (hard, soft)]
    assert spread[0] <= 3 and spread[1] > 10_000


def test_leaking_pixels_are_still_exact():
    model = replace(SENSOR, leak_hz=1.0)
    view = view_of()
    events = record(view, model, END_US, 0)
    index = events.x == 30
    times = events.t_us[index & (events.y == 0)]
    change = np.diff(Stripes().log_radiance(0.5 / 80 + 0.5e-6 * times) + 0.2e-6 * times)
    polarity = events.polarity[index & (events.y == 0)][1:]
    assert np.allclose(change, np.where(polarity > 0, 0.2, -0.3), atol=5e-5)


@pytest.mark.parametrize("drift", [-1.0, 1.0])
def test_drifting_thresholds_leave_the_order_of_a_pixels_events(drift: float):
    model = replace(SENSOR, threshold_drift=drift)
    events, steady = record(view_of(), model, END_US, 0), record(view_of(), SENSOR, END_US, 0)
    assert len(events) == pytest.approx(len(steady), rel=0.3)
    for x in range(0, 60, 7):
        mine = (events.x == x) & (events.y == 0)
        # A sinusoid is monotonic between extrema, so that runs of one polarity alternate with runs of the other.
        runs = 1 + np.count_nonzero(np.diff(events.polarity[mine]))
        assert runs <= 10


def test_no_event_falls_in_the_refractory_period():
    events = record(view_of(speed_m_s=5.0), replace(SENSOR, refractory_us=2000.0), END_US, 0)
    gaps = [np.diff(events.t_us[(events.x == x) & (events.y == 1)]).min() for x in range(60)]
    assert min(gaps) >= 1999
