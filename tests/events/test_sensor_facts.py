"""Sensor properties estimated from recordings of the test sensor."""

from pathlib import Path

import numpy as np
import pytest

from ebarf_ns.events.recording import Recording, RecordingFile
from ebarf_ns.events.sensor_facts import (
    UNKNOWN_SENSOR,
    estimated_refractory_us,
    estimated_threshold_ratio,
    identify,
    identify_recording,
)
from tests.conftest import DATA
from tests.events.sensors import HEIGHT, WIDTH, index_of, one_way, photograph, record, stripes, to_and_fro


@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.0, 1.3, 2.0])
@pytest.mark.parametrize(
    ("texture", "motion", "refractory_us"),
    [(photograph, to_and_fro, 0), (photograph, one_way, 1000), (stripes, one_way, 0), (stripes, to_and_fro, 2000)],
    ids=["photograph by hand", "photograph one way, blind", "stripes one way", "stripes by hand, blind"],
)
def test_the_ratio_of_thresholds_is_found_within_six_percent(texture, motion, refractory_us: int, ratio: float):
    made = record(texture, motion, 0.2 * ratio**0.5, 0.2 / ratio**0.5, refractory_us, 20, seed=3)
    found = estimated_threshold_ratio(index_of(made), refractory_us)
    assert found.value == pytest.approx(ratio, rel=0.06)
    assert found.low < ratio < found.high and found.high / found.low > 1.12


@pytest.mark.parametrize("jitter_us", [0, 50])
@pytest.mark.parametrize("refractory_us", [500, 1000, 3000])
def test_refractory_periods_are_found(refractory_us: int, jitter_us: int):
    index = index_of(record(photograph, to_and_fro, refractory_us=refractory_us, jitter_us=jitter_us))
    found = estimated_refractory_us(index)
    assert found.value == pytest.approx(refractory_us, rel=0.35)
    assert found.low <= found.value <= found.high


def test_fast_edges_are_hardly_mistaken_for_a_refractory_period():
    index = index_of(record(photograph, to_and_fro))
    assert estimated_refractory_us(index).value < 200


def test_pixels_that_fire_at_once_are_not_blind():
    made = record(photograph, to_and_fro)
    # Edges that are crossed within a microsecond, as in simulations.
    again = Recording(*(np.repeat(column, 2) for column in (made.x, made.y, made.t_us, made.polarity)))
    assert estimated_refractory_us(index_of(again)).value == 0


def test_a_tiny_recording_gives_no_estimates():
    random = np.random.default_rng(0)
    t_us = np.sort(random.integers(0, 10**6, 3000))
    x, y = random.integers(0, WIDTH, 3000).astype(np.uint16), random.integers(0, HEIGHT, 3000).astype(np.uint16)
    one_sided = identify(index_of(Recording(x, y, t_us, np.ones(3000, np.int8))))
    assert one_sided.refractory_us.value == 0 and one_sided.threshold_ratio == UNKNOWN_SENSOR.threshold_ratio


def test_given_values_take_precedence_over_estimates():
    made = record(photograph, to_and_fro, 0.3, 0.2, 1000)
    counted, ignored = (identify(index_of(made), refractory_us) for refractory_us in (1000, 0))
    assert counted.refractory_us == ignored.refractory_us
    assert counted.threshold_ratio.value != ignored.threshold_ratio.value
    assert counted.threshold_ratio.value == pytest.approx(1.5, rel=0.05)


@pytest.mark.skipif(not DATA.is_dir(), reason="the real recordings are not at hand")
@pytest.mark.parametrize(
    ("name", "size", "blind_us", "ratio", "hot"),
    [
        ("shapes_rotation", (240, 180), (1500, 2500), (1.2, 1.8), 1),
        ("office_pan_tilt", (190, 180), (1500, 2500), (0.36, 0.66), 6),
        ("photos_clean", (160, 120), (0, 0), (0.97, 1.03), 0),
        ("photos_davis", (240, 180), (350, 700), (1.24, 1.4), 10),
    ],
)
def test_foreign_recordings(name: str, size: tuple[int, int], blind_us: tuple, ratio: tuple, hot: int):
    file = RecordingFile(Path(DATA / name / "events.h5"), *size)
    facts = identify_recording(file, (0, 10**9))
    assert blind_us[0] <= facts.refractory_us.value <= blind_us[1]
    assert ratio[0] <= facts.threshold_ratio.value <= ratio[1]
    assert facts.hot_pixels == hot and facts.dead_pixels == 0
