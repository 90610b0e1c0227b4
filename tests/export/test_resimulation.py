"""Events of the true room are those that the simulator itself makes of it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ebarf_ns.errors import ExportError
from ebarf_ns.events.recording import read_recording
from ebarf_ns.export.resimulation import agreement, write_events
from ebarf_ns.export.settings import Span
from ebarf_ns.simulation.record import record
from ebarf_ns.simulation.sensor import SensorModel
from ebarf_ns.simulation.view import View
from tests.export.subjects import MOTION, PINHOLE, ROOM, KnownRoom

SPAN = Span(end_us=1_100_000)


def test_events_are_those_of_the_simulator(known: KnownRoom, tmp_path: Path):
    events = write_events(known, SPAN, tmp_path / "out.h5")
    read = read_recording(tmp_path / "out.h5", PINHOLE.width, PINHOLE.height)
    assert (read.t_us == events.t_us).all() and (read.polarity == events.polarity).all()
    assert 1_000_000 <= read.t_us[0] and read.t_us[-1] <= 1_100_000
    real = record(View(ROOM, MOTION, PINHOLE, rays_per_pixel=1), SensorModel(), 100_000, seed=0)
    found = agreement(events, real, PINHOLE.width, PINHOLE.height)
    assert found["predicted"] == pytest.approx(found["recorded"], rel=0.02) and len(real) > 1000
    assert min(found["brighter_correlation"], found["darker_correlation"]) > 0.98


def test_the_sensor_is_the_subjects(known: KnownRoom, tmp_path: Path):
    usual = write_events(known, SPAN, tmp_path / "usual.h5")
    known.sensor = SensorModel(threshold_on=0.5, refractory_us=20_000)
    other = write_events(known, SPAN, tmp_path / "other.h5")
    assert np.sum(other.polarity > 0) < 0.6 * np.sum(usual.polarity > 0)
    pixel = other.pixels(PINHOLE.width)
    order = np.lexsort((other.t_us, pixel))
    apart_us = np.diff(other.t_us[order])[np.diff(pixel[order]) == 0]
    assert len(apart_us) and apart_us.min() >= 19_999


def test_agreement_tells_wrong_from_right(known: KnownRoom, tmp_path: Path):
    events = write_events(known, SPAN, tmp_path / "out.h5")
    mirrored = replace(events, x=(PINHOLE.width - 1 - events.x).astype(np.uint16))
    assert agreement(events, events, 64, 48)["darker_correlation"] == pytest.approx(1)
    assert agreement(mirrored, events, 64, 48)["darker_correlation"] < 0.5
    nothing = events.select(slice(0))
    assert agreement(nothing, events, 64, 48)["brighter_correlation"] == 0


def test_times_without_poses_are_refused(known: KnownRoom, tmp_path: Path):
    with pytest.raises(ExportError, match="the span of the refined trajectory"):
        write_events(known, Span(start_us=-1), tmp_path / "out.h5")
    with pytest.raises(ExportError, match="1500000 to 1500000 us, expected a longer one"):
        write_events(known, Span(start_us=1_500_000, end_us=1_500_000), tmp_path / "out.h5")
    assert not list(tmp_path.iterdir())
