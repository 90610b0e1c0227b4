from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.recording import Recording, read_recording
from ebarf_ns.events.timing import clock_step_us, doubles, flicker_hz
from tests.conftest import DATA

HEIGHT, WIDTH = 24, 32
SHAPE, PIXELS = (HEIGHT, WIDTH), HEIGHT * WIDTH
EVERYWHERE = np.ones(SHAPE, bool)
TENTH = np.zeros(SHAPE, bool)
TENTH[4:12, 5:15] = True

Events = tuple[np.ndarray, np.ndarray, np.ndarray]
Light = Callable[[float], np.ndarray]


def indexed(events: Events) -> tuple[np.ndarray, np.ndarray]:
    """Sorted events and the start index of each pixel."""
    pixel, t_us, polarity = (column[np.argsort(events[1], kind="stable")] for column in events)
    x, y = (pixel % WIDTH).astype(np.uint16), (pixel // WIDTH).astype(np.uint16)
    recording = Recording(x, y, t_us.astype(np.int64), polarity.astype(np.int8))
    index = index_pairs(lambda: [recording], WIDTH, HEIGHT)
    return index.events, index.first


def fired(light: Light, seconds: float, step_us: int = 200, blind_us: int = 0) -> Events:
    """Events of pixels with thresholds of 0.25 (3 % mismatch) for a log brightness over time in seconds."""
    random = np.random.default_rng(0)
    thresholds = {sign: 0.25 * (1 + 0.03 * random.standard_normal(SHAPE)) for sign in (1, -1)}
    before = light(0.0)
    level, last_us = before - 0.25 * random.random(SHAPE), np.full(PIXELS, -1e9)
    found = []
    for k in range(1, int(seconds * 1e6 / step_us) + 1):
        now = light(k * step_us * 1e-6)
        for sign, threshold in thresholds.items():
            while (hit := sign * (now - level) >= threshold).any():
                level[hit] += sign * threshold[hit]
                share = (level - before)[hit] / np.where(now == before, 1, now - before)[hit]
                pixel, t_us = np.flatnonzero(hit), (k - 1 + np.clip(share, 0, 1)) * step_us
                seen = t_us - last_us[pixel] >= blind_us
                last_us[pixel[seen]] = t_us[seen]
                found.append((pixel[seen], t_us[seen].astype(np.int64), np.full(seen.sum(), sign)))
        before = now
    pixel, t_us, polarity = (np.concatenate(columns) for columns in zip(*found, strict=True))
    return pixel, t_us, polarity


def joined(*parts: Events) -> Events:
    pixel, t_us, polarity = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return pixel, t_us, polarity


def noise(seconds: float, hz: float = 1, pixels: int = PIXELS) -> Events:
    """Poisson events of the first pixels."""
    random = np.random.default_rng(1)
    count = random.poisson(hz * seconds * pixels)
    t_us = random.integers(int(seconds * 1e6), size=count)
    return random.integers(pixels, size=count), t_us, random.choice([-1, 1], count)


TEXTURE = gaussian_filter(np.random.default_rng(2).standard_normal((512, 512)), 1.5, mode="wrap")
TEXTURE *= 0.6 / TEXTURE.std()


def bars(period: int) -> np.ndarray:
    return np.tile(np.where(np.arange(512) % period < period // 2, 0.5, -0.5), (512, 1))


def moving(picture: np.ndarray, vx: float, vy: float = 0, shaken_hz: float = 0) -> Light:
    """A picture that moves at a velocity in pixels per second, or is shaken."""
    y, x = np.mgrid[:HEIGHT, :WIDTH].astype(float)

    def light(t: float) -> np.ndarray:
        shake = 0.7 * np.sin(2 * np.pi * shaken_hz * t)
        return map_coordinates(picture, [y + vy * t, x + vx * t + shake], order=1, mode="grid-wrap")

    return light


def lit(light: Light, hz: float, amplitude: float, where: np.ndarray = EVERYWHERE, drift_hz: float = 0) -> Light:
    """The same scene under a flickering lamp whose frequency drifts by ``drift_hz`` per second."""

    def under_lamp(t: float) -> np.ndarray:
        return light(t) + where * np.log1p(amplitude * np.cos(2 * np.pi * (hz + drift_hz * t / 2) * t))

    return under_lamp


@pytest.fixture(scope="module")
def ordinary() -> Events:
    return joined(fired(moving(TEXTURE, 60, 13), 1.0, blind_us=300), noise(1.0))


@pytest.mark.parametrize("step", [5, 10, 100, 125, 1000, 10000, 1e6 / 3000, 1e6 / 60])
@pytest.mark.parametrize("rounded", [np.floor, np.rint])
def test_step_of_the_clock_is_found(step: float, rounded: Callable[[np.ndarray], np.ndarray], ordinary: Events):
    t_us = rounded(ordinary[1] // step * step).astype(np.int64) + 123_456_789_012_345
    off = np.random.default_rng(0).random(len(t_us)) < 0.005
    t_us[off] += np.random.default_rng(1).integers(1000, size=off.sum())
    assert clock_step_us(t_us) == round(step)


def test_step_of_the_clock_of_a_slow_and_of_a_long_recording():
    t_us = 100 * np.sort(np.random.default_rng(0).integers(200_000, size=20_000))
    assert clock_step_us(t_us) == 100
    assert clock_step_us(t_us + np.random.default_rng(1).integers(0, 50, size=20_000)) == 1
    many = 1000 * np.random.default_rng(0).integers(5_000, size=11_000_000)
    assert clock_step_us(many) == 1000


def test_ordinary_clocks_have_no_step(ordinary: Events):
    assert clock_step_us(ordinary[1]) == 1
    assert clock_step_us(fired(lit(moving(TEXTURE, 60), 100, 0.3), 0.5)[1]) == 1
    assert clock_step_us(noise(1.0, 1000, 1)[1]) == 1
    for few in ([], [5], [5, 10], [7] * 1000, [7, 1007] * 500):
        assert clock_step_us(np.array(few, np.int64)) == 1
    # Two mixed clocks, only one of which has steps.
    mixed = np.where(np.arange(len(ordinary[1])) % 20 == 0, ordinary[1], ordinary[1] // 100 * 100)
    assert clock_step_us(mixed) == 1


def doubled(events: Events, share: float, within_us: int) -> Events:
    """Repeat a share of the events up to ``within_us`` later."""
    random = np.random.default_rng(3)
    pixel, t_us, polarity = events
    again = random.choice(len(pixel), int(share * len(pixel)), replace=False)
    later_us = random.integers(within_us + 1, size=len(again))
    return joined(events, (pixel[again], t_us[again] + later_us, polarity[again]))


@pytest.mark.parametrize(("share", "within_us"), [(0.004, 8), (0.025, 3), (0.02, 0), (0.02, 40)])
def test_doubles_are_found(share: float, within_us: int, ordinary: Events):
    found, found_within_us = doubles(*indexed(doubled(ordinary, share, within_us)))
    assert found == pytest.approx(share / (1 + share), rel=0.15)
    assert 0.9 * within_us <= found_within_us <= 1.5 * within_us + 3


def test_doubles_of_a_sensor_with_noise_and_a_clock_of_5_us(ordinary: Events):
    pixel, t_us, polarity = joined(doubled(ordinary, 0.02, 3), noise(1.0, 300, 1))
    assert doubles(*indexed((pixel, t_us, polarity)))[0] == pytest.approx(0.02, rel=0.2)
    stepped = indexed((pixel, t_us // 5 * 5, polarity))
    assert doubles(*stepped, clock_step_us=5)[0] == pytest.approx(0.02, rel=0.2)
    assert doubles(*stepped, clock_step_us=20) == (0.0, 0)


@pytest.mark.parametrize("speed", [60, 1000])
@pytest.mark.parametrize("blind_us", [0, 500])
@pytest.mark.parametrize("jitter_us", [0, 20, 100])
def test_no_doubles_without_a_gap(speed: float, blind_us: int, jitter_us: float):
    pixel, t_us, polarity = fired(moving(TEXTURE, speed), 0.4, blind_us=blind_us)
    jitter = jitter_us * np.random.default_rng(4).standard_normal(len(t_us))
    assert doubles(*indexed((pixel, np.maximum(t_us + jitter, 0).astype(np.int64), polarity))) == (0.0, 0)


def test_no_doubles_in_flashes_noise_and_tiny_recordings():
    flash = fired(lambda t: np.full(SHAPE, 2.0 * (t > 0.1) - 2.0 * (t > 0.2)), 0.3)
    assert doubles(*indexed(flash)) == (0.0, 0)
    assert doubles(*indexed(noise(1.0, 1000, 20))) == (0.0, 0)
    two = np.array([3, 3]), np.array([10, 5000]), np.array([1, 1])
    assert doubles(*indexed(two)) == (0.0, 0)


@pytest.mark.parametrize("where", [EVERYWHERE, TENTH], ids=["everywhere", "a tenth"])
@pytest.mark.parametrize(
    ("hz", "amplitude"), [(100, 0.2), (100, 0.6), (120, 0.3), (85.3, 0.3), (50, 0.3), (40, 0.4), (440, 0.3)]
)
def test_flicker_beside_moving_edges(hz: float, amplitude: float, where: np.ndarray):
    found = flicker_hz(*indexed(joined(fired(lit(moving(TEXTURE, 60, 13), hz, amplitude, where), 1.0), noise(1.0))))
    assert found.hz == pytest.approx(hz, abs=0.1)
    assert found.share_of_pixels == pytest.approx(where.mean(), rel=0.1)
    assert found.pixels[where.ravel()].mean() > 0.9 and not found.pixels[~where.ravel()].any()


@pytest.mark.parametrize("seconds", [0.25, 3.0])
def test_flicker_in_short_recordings_and_when_mains_drift(seconds: float):
    light = lit(moving(TEXTURE, 60, 13), 100, 0.3, TENTH, drift_hz=0.2)
    found = flicker_hz(*indexed(joined(fired(light, seconds), noise(seconds))))
    assert found.hz == pytest.approx(100 + 0.1 * seconds, abs=0.2)
    np.testing.assert_array_equal(found.pixels, TENTH.ravel())


@pytest.mark.parametrize("step_us", [300, 1000, 2000])
def test_flicker_is_found_with_a_refractory_period_and_a_stepped_clock(step_us: int):
    light = lit(moving(TEXTURE, 60, 13), 100, 0.3, TENTH)
    pixel, t_us, polarity = fired(light, 1.0, blind_us=500)
    found = flicker_hz(*indexed((pixel, t_us // step_us * step_us, polarity)), clock_step_us=step_us)
    assert found.hz == pytest.approx(100, abs=0.1)
    np.testing.assert_array_equal(found.pixels, TENTH.ravel())


def test_a_too_short_recording_has_no_flicker():
    found = flicker_hz(*indexed(fired(lit(moving(TEXTURE, 60), 100, 0.6), 0.19)))
    assert found.hz is None and found.share_of_pixels == 0 and found.pixels.shape == (PIXELS,)
    assert not found.pixels.any()


@pytest.mark.parametrize(
    "light",
    [
        moving(TEXTURE, 60, 13),
        moving(TEXTURE, 100),
        moving(TEXTURE, 500),
        # Edges that cross all pixels of a column at once, column by column at a constant rate.
        moving(bars(8), 100),
        moving(bars(8), 500),
        # A grating under which pixels oscillate at 100 Hz with different phases.
        moving(bars(4), 400),
        moving(bars(12), 1200),
        moving(TEXTURE, 20, 5, shaken_hz=80),
        # 25 Hz frames that disturb all pixels.
        lambda t: moving(TEXTURE, 60, 13)(t) + 0.4 * (25 * t % 1 < 0.05),
        # A lamp too faint for pixels to follow.
        lit(moving(TEXTURE, 60, 13), 100, 0.05),
    ],
)
@pytest.mark.parametrize("seconds", [0.3, 1.5])
def test_motion_is_not_flicker(light: Light, seconds: float):
    assert flicker_hz(*indexed(fired(light, seconds))).hz is None


@pytest.mark.parametrize(("hz", "pixels"), [(20, PIXELS), (1000, 3), (1000, 300)])
def test_noise_and_hot_pixels_are_not_flicker(hz: float, pixels: int):
    assert flicker_hz(*indexed(noise(1.0, hz, pixels))).hz is None


@pytest.mark.parametrize("step", [1e6 / 3000, 1000, 2000, 10000, 1e6 / 60])
@pytest.mark.parametrize("speed", [60, 400])
def test_clock_steps_are_not_flicker(step: float, speed: float):
    pixel, t_us, polarity = fired(moving(TEXTURE, speed, 13), 1.0)
    t_us = np.rint(t_us // step * step).astype(np.int64)
    assert flicker_hz(*indexed((pixel, t_us, polarity)), clock_step_us=clock_step_us(t_us)).hz is None


@pytest.mark.parametrize(
    ("name", "width", "height"),
    [
        ("office_pan_tilt", 190, 180),
        ("shapes_rotation", 240, 180),
        ("photos_clean", 160, 120),
        ("photos_davis", 240, 180),
        ("photos_dim", 160, 120),
    ],
)
def test_foreign_recordings(name: str, width: int, height: int):
    path = DATA / name / "events.h5"
    if not path.exists():
        pytest.skip(f"no recordings at {DATA}; set EBARF_TEST_DATA to their folder")
    recording = read_recording(path, width, height)
    index = index_pairs(lambda: [recording], width, height)
    assert clock_step_us(recording.t_us) == 1
    # Frames at 19.6 Hz disturb the pixels of the office recording: lines at 98 and 118 Hz that are not lamps.
    assert flicker_hz(index.events, index.first).hz is None
    share, within_us = doubles(index.events, index.first)
    if name == "office_pan_tilt":
        assert 0.003 <= share < 0.004 and within_us <= 10
    else:
        assert (share, within_us) == (0.0, 0)
