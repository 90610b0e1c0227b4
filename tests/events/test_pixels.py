import numpy as np
import pytest

from ebarf_ns.events.pixels import dead_pixels, hot_pixels

WIDTH, HEIGHT = 40, 30
RANDOM = np.random.default_rng(0)


def busy(mean: float) -> np.ndarray:
    return RANDOM.poisson(mean, WIDTH * HEIGHT)


@pytest.mark.parametrize("mean", [0, 1, 30, 1000])
def test_evenly_busy_pixels_are_neither_hot_nor_dead(mean: float):
    counts = busy(mean)
    assert not hot_pixels(counts, WIDTH).any() and (mean == 1 or not dead_pixels(counts, WIDTH).any())


@pytest.mark.parametrize("mean", [0, 5, 30])
def test_single_and_paired_hot_pixels_are_found_also_at_the_border(mean: float):
    counts, places = busy(mean), [0, 5 * WIDTH + 7, 5 * WIDTH + 8, WIDTH * HEIGHT - 1]
    counts[places] = 4 * mean + 100
    assert np.array_equal(np.nonzero(hot_pixels(counts, WIDTH))[0], places)


def test_edges_along_rows_columns_and_diagonals_are_not_hot():
    counts = np.zeros((HEIGHT, WIDTH), np.int64)
    counts[4], counts[:, 9] = 500, 500
    counts[np.arange(HEIGHT), np.arange(HEIGHT)] = 500
    assert not hot_pixels(counts.ravel(), WIDTH).any()


def test_dead_pixels_are_distinguished_from_silent_ones_by_their_neighbours():
    counts = busy(30).reshape(HEIGHT, WIDTH)
    # A blank wall: its silent pixels may well work.
    counts[10:25, 15:35] = 0
    counts[3, 3] = 0
    dead = dead_pixels(counts.ravel(), WIDTH)
    assert np.array_equal(np.nonzero(dead)[0], [3 * WIDTH + 3])


def test_columns_and_rows_without_event_pixels_are_dead_throughout():
    counts = busy(30).reshape(HEIGHT, WIDTH)
    counts[:, 31:], counts[:2] = 0, 0
    dead = dead_pixels(counts.ravel(), WIDTH).reshape(HEIGHT, WIDTH)
    assert dead[:, 31:].all() and dead[:2].all() and not dead[2:, :31].any()


def test_a_blank_sky_above_a_skyline_is_not_dead():
    counts = busy(30).reshape(HEIGHT, WIDTH)
    skyline = 8 + np.abs(np.arange(WIDTH) % 16 - 8)
    counts[np.arange(HEIGHT)[:, None] < skyline] = 0
    assert not dead_pixels(counts.ravel(), WIDTH).any()


def test_a_few_active_pixels_do_not_make_the_others_dead():
    counts = np.zeros(WIDTH * HEIGHT, np.int64)
    counts[[100, 500, 900]] = 15
    assert not hot_pixels(counts, WIDTH).any() and not dead_pixels(counts, WIDTH).any()


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (2, 2), (3, 3)])
def test_sensors_smaller_than_a_neighbourhood_work(shape: tuple[int, int]):
    counts = np.full(shape[0] * shape[1], 7)
    assert not hot_pixels(counts, shape[1]).any() and not dead_pixels(counts, shape[1]).any()
