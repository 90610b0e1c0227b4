import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.batches import DrawAhead, HeldoutBlocks, batch_random
from ebarf_ns.events.indexing import index_pairs
from ebarf_ns.events.pairs import EventPairs, PairIndex, draw_steps
from ebarf_ns.events.recording import Recording, accumulate

WIDTH, HEIGHT = 4, 3


def recording(seed: int, count: int) -> Recording:
    random = np.random.default_rng(seed)
    return Recording(
        random.integers(0, WIDTH, count).astype(np.uint16),
        random.integers(0, HEIGHT, count).astype(np.uint16),
        np.sort(random.integers(0, 1000, count)).astype(np.int64),
        random.choice([-1, 1], count).astype(np.int8),
    )


def index_of(events: Recording, chunk: int = 50, memory_bytes: int = 1 << 40) -> PairIndex:
    """Index built from pieces of ``chunk`` events."""
    pieces = [events.select(slice(k, k + chunk)) for k in range(0, len(events), chunk)]
    return index_pairs(lambda: pieces, WIDTH, HEIGHT, memory_bytes)


def by_pixel(events: Recording) -> dict[int, list[int]]:
    found: dict[int, list[int]] = {}
    for i in range(len(events)):
        found.setdefault(int(events.y[i]) * WIDTH + int(events.x[i]), []).append(i)
    return found


@settings(max_examples=30)
@given(st.integers(0, 1000), st.integers(30, 200), st.integers(1, 5))
def test_every_pair_matches_the_event_stream(seed: int, count: int, steps: int):
    events = recording(seed, count)
    index = index_of(events)
    steps = min(steps, index.max_steps)
    pairs = index.draw(np.full(300, steps), np.random.default_rng(seed))
    truth = by_pixel(events)
    for pixel, t0, t1, total, number in zip(
        pairs.pixel, pairs.t0_us, pairs.t1_us, pairs.polarity_sum, pairs.event_count, strict=True
    ):
        rows = truth[int(pixel)]
        assert number == steps
        assert any(
            events.t_us[rows[k - steps]] == t0
            and events.t_us[rows[k]] == t1
            and events.polarity[rows[k - steps + 1 : k + 1]].sum() == total
            for k in range(steps, len(rows))
        )


@settings(max_examples=30)
@given(st.integers(0, 1000), st.integers(30, 200), st.integers(1, 5))
def test_every_silent_pair_matches_the_event_stream(seed: int, count: int, longest: int):
    events = recording(seed, count)
    pairs = index_of(events).draw_silent(300, longest, (0, 1000), np.random.default_rng(seed))
    truth = by_pixel(events)
    assert len(pairs) == 300 and pairs.silent.all() and np.array_equal(pairs.pixel, pairs.pixel_before)
    for pixel, t0, t1, total, number in zip(
        pairs.pixel, pairs.t0_us, pairs.t1_us, pairs.polarity_sum, pairs.event_count, strict=True
    ):
        rows = [row for row in truth.get(int(pixel), []) if events.t_us[row] <= t1]
        if not rows:
            # Silent from the beginning: no change between any two times.
            assert number == total == 0 and 0 <= t0 <= t1
            continue
        begin = len(rows) - 1 - int(number)
        assert 0 <= number <= longest and begin >= 0
        assert events.t_us[rows[begin]] == t0 and events.polarity[rows[begin + 1 :]].sum() == total


def test_silent_pairs_cover_all_times_and_all_pixels_including_silent_ones():
    events = recording(1, 400)
    events = events.select(events.x + events.y < 3)
    pairs = index_of(events).draw_silent(20_000, 3, (0, 2000), np.random.default_rng(0))
    assert set(pairs.pixel.tolist()) == set(range(WIDTH * HEIGHT))
    never = ~np.isin(pairs.pixel, list(by_pixel(events)))
    assert never.any() and (pairs.event_count[never] == 0).all() and (pairs.duration_us[never] > 1000).any()
    # Times after the last event of all are uniform.
    late = pairs.t1_us[pairs.t1_us > 1000]
    assert np.abs(np.histogram(late, 10, (1000, 2000))[0] / len(late) - 0.1).max() < 0.02
    assert set(pairs.event_count.tolist()) == {0, 1, 2, 3}


def test_all_pairs_are_drawn_uniformly():
    events = recording(1, 60)
    # Unique times identify the events.
    events = Recording(events.x, events.y, np.arange(60, dtype=np.int64), events.polarity)
    index = index_of(events)
    for steps in (1, 3):
        expected = sum(max(0, len(rows) - steps) for rows in by_pixel(events).values())
        assert index.count(np.array(steps)) == expected
        drawn = index.draw(np.full(200 * expected, steps), np.random.default_rng(0))
        counts = np.unique(drawn.t1_us, return_counts=True)[1]
        assert len(counts) == expected
        # 200 draws per pair on average; the bound is five standard deviations.
        assert np.abs(counts - 200).max() < 5 * np.sqrt(200)


def test_heldout_pairs_end_inside_and_training_pairs_stay_outside():
    events = recording(2, 400)
    blocks = HeldoutBlocks(int(events.t_us[0]), int(events.t_us[-1]), 0.3, blocks=4)
    heldout = blocks.contain(events.t_us)
    assert 0.15 < heldout.mean() < 0.45
    index, random = index_of(events), np.random.default_rng(0)
    inside = set(events.t_us[heldout].tolist())
    drawn = index.draw_accepted(500, 10, random, blocks.training)
    assert len(drawn) == 500 and not inside & (set(drawn.t0_us.tolist()) | set(drawn.t1_us.tolist()))
    drawn = index.draw_accepted(500, 10, random, blocks.heldout)
    assert len(drawn) == 500 and set(drawn.t1_us.tolist()) <= inside


def test_no_accepted_pair_gives_an_empty_batch():
    drawn = index_of(recording(2, 400)).draw_accepted(
        50, 10, np.random.default_rng(0), lambda pairs: np.zeros(len(pairs), bool)
    )
    assert len(drawn) == 0


def test_training_pairs_across_a_heldout_block_count_the_events_in_it():
    t = np.arange(5, dtype=np.int64)
    ones = np.ones(5, np.int8)
    index = index_of(Recording(np.zeros(5, np.uint16), np.zeros(5, np.uint16), t, ones))
    blocks = HeldoutBlocks(0, 4, 0.6, blocks=1)
    assert blocks.contain(t).tolist() == [False, True, True, True, False]
    pairs = index.draw_accepted(50, 4, np.random.default_rng(0), blocks.training)
    assert len(pairs) and (pairs.polarity_sum == 4).all() and (pairs.event_count == 4).all()


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(1, 300), st.integers(16, 2000))
def test_index_does_not_depend_on_chunk_size_or_storage(seed: int, chunk: int, memory_bytes: int):
    events = recording(seed, 300)
    whole, pieces = index_of(events, 300), index_of(events, chunk, memory_bytes)
    assert isinstance(pieces.events, np.memmap) and not isinstance(whole.events, np.memmap)
    for name in ("events", "first", "busiest", "events_before"):
        assert np.array_equal(getattr(whole, name), getattr(pieces, name))


def test_prefetched_batches_match_the_requested_ones():
    index = index_of(recording(3, 300))
    drawn: list[int] = []

    def draw(batch: int) -> EventPairs:
        drawn.append(batch)
        random = batch_random(0, batch)
        return index.draw(draw_steps(20, 5, random), random)

    ahead = DrawAhead(draw, stride=2)
    for batch in (0, 2, 4, 10, 12, 12):
        assert np.array_equal(ahead.batch(batch).t1_us, draw(batch).t1_us)
    assert 14 in drawn


def test_a_batch_depends_only_on_seed_and_number():
    assert np.array_equal(batch_random(3, 7).integers(1 << 60, size=9), batch_random(3, 7).integers(1 << 60, size=9))
    assert not np.array_equal(
        batch_random(3, 7).integers(1 << 60, size=9), batch_random(3, 8).integers(1 << 60, size=9)
    )
    assert not np.array_equal(
        batch_random(3, 7).integers(1 << 60, size=9), batch_random(4, 7).integers(1 << 60, size=9)
    )


def test_steps_are_log_uniform():
    steps = draw_steps(100_000, 30, np.random.default_rng(0))
    assert steps.min() == 1 and steps.max() == 30
    assert (steps == 1).mean() == pytest.approx(np.log(2) / np.log(31), abs=0.01)
    assert (draw_steps(100, 1, np.random.default_rng(0)) == 1).all()


def test_no_pixel_with_two_events_is_an_error():
    events = Recording(
        np.arange(4, dtype=np.uint16), np.zeros(4, np.uint16), np.arange(4, dtype=np.int64), np.ones(4, np.int8)
    )
    with pytest.raises(RecordingError, match="no pair to train on"):
        index_of(events)


def test_accumulated_picture_shows_polarity():
    events = Recording(
        np.array([1, 1, 2], np.uint16), np.array([0, 0, 1], np.uint16), np.arange(3, dtype=np.int64),
        np.array([1, 1, -1], np.int8),
    )  # fmt: skip
    picture = accumulate(events, WIDTH, HEIGHT)
    assert picture[0, 1] > 128 > picture[1, 2] and picture[2, 3] == 128


def test_a_full_disk_is_reported(monkeypatch: pytest.MonkeyPatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with pytest.raises(RecordingError, match="no room for an index of .*TMPDIR"):
        index_of(recording(0, 300), memory_bytes=16)


def test_an_index_on_disk_does_not_need_posix_fallocate(monkeypatch: pytest.MonkeyPatch):
    events = recording(3, 300)
    whole = index_of(events)
    monkeypatch.delattr("os.posix_fallocate", raising=False)
    on_disk = index_of(events, memory_bytes=16)
    assert isinstance(on_disk.events, np.memmap) and np.array_equal(whole.events, on_disk.events)


def test_edges_that_have_nearly_all_events_count_in_full():
    random = np.random.default_rng(0)
    pixel = np.r_[np.repeat(np.arange(180), 1000), np.arange(180, 20_000)]
    pixel = pixel[random.permutation(len(pixel))]
    t_us = np.sort(random.integers(0, 10**6, len(pixel)))
    x, y = (pixel % 200).astype(np.uint16), (pixel // 200).astype(np.uint16)
    index = index_pairs(lambda: [Recording(x, y, t_us, np.ones(len(pixel), np.int8))], 200, 100)
    assert index.max_steps == 999 and index.events_before[-1] == len(pixel)


def test_hot_pixels_are_excluded_by_default():
    random = np.random.default_rng(0)
    pixel = random.permutation(np.r_[np.repeat(np.arange(100), 30), np.full(1000, 100)])
    x, zeros = pixel.astype(np.uint16), np.zeros(len(pixel), np.uint16)
    t_us = np.sort(random.integers(0, 10**6, len(pixel)))
    index = index_pairs(lambda: [Recording(x, zeros, t_us, np.ones(len(pixel), np.int8))], 200, 1)
    every = index.with_hot_pixels()
    assert index.hot_pixels == 1 and every.hot_pixels == 0
    assert index.events_before[-1] == 3000 and every.events_before[-1] == 4000
    drawn = [which.draw(np.full(1000, 1), np.random.default_rng(0)) for which in (index, every)]
    assert [(pairs.pixel == 100).any() for pairs in drawn] == [False, True]


def spaced(intervals_us: np.ndarray) -> PairIndex:
    """ON events of one pixel at these intervals."""
    t_us = np.r_[0, np.cumsum(intervals_us)].astype(np.int64)
    zeros = np.zeros(len(t_us), np.uint16)
    return index_of(Recording(zeros, zeros, t_us, np.ones(len(t_us), np.int8))).with_hot_pixels()


def test_blank_pixels_are_paired_only_with_blank_ones_at_one_time():
    random = np.random.default_rng(0)
    # The left half of the sensor fires; in the right half, only one pixel does.
    pixel = random.integers(0, 40 * 20, 20_000)
    x, y = np.where(pixel % 40 < 20, pixel % 40, 35), np.where(pixel % 40 < 20, pixel // 40, 10)
    t_us = np.sort(random.integers(0, 10**6, len(pixel)))
    columns = (x.astype(np.uint16), y.astype(np.uint16), t_us, np.ones(len(pixel), np.int8))
    index = index_pairs(lambda: [Recording(*columns)], 40, 20)
    assert len(index.blank) == 20 * 20 - 1
    pairs = index.draw_blank(2000, 40, (0, 10**6), random)
    blank = set(index.blank.tolist())
    assert 500 < len(pairs) < 2000
    assert set(pairs.pixel.tolist()) | set(pairs.pixel_before.tolist()) <= blank
    assert (pairs.duration_us == 0).all() and not pairs.silent.any() and (pairs.event_count == 0).all()
    apart = pairs.pixel % 40 - pairs.pixel_before % 40
    assert 2 < apart.std() < 4.5


@pytest.mark.parametrize("steps", [1, 3, 12])
def test_events_missed_in_the_refractory_period_are_estimated(steps: int):
    # Brightness rises by a threshold in 4 ms; the refractory period is 1 ms.
    index = spaced(np.full(300, 5000))
    rate_per_us = 1 / 4000
    pairs = index.draw(np.full(50, steps), np.random.default_rng(0), 1000)
    assert np.allclose(pairs.polarity_sum, rate_per_us * (pairs.t1_us - pairs.t0_us))
    assert np.array_equal(pairs.polarity_sum, pairs.event_count) and (pairs.variance >= steps).all()
    plain = index.draw(np.full(50, steps), np.random.default_rng(0))
    assert (plain.polarity_sum == steps).all() and (plain.variance == steps).all()
    assert np.array_equal(plain.t0_us + 1000, pairs.t0_us)


@pytest.mark.parametrize(
    ("polarity", "polarity_sum", "event_count"),
    [
        # Blind half of the time: one event of the same polarity is missed after each event.
        ([1, 1, -1, -1, 1, 1], 1, 9),
        # Polarities that alternate give no rate to extrapolate.
        ([1, -1, 1, -1, 1, -1], -1, 5),
    ],
)
def test_missed_events_are_estimated_from_neighbours_of_equal_polarity(
    polarity: list[int], polarity_sum: int, event_count: int
):
    zeros = np.zeros(6, np.uint16)
    index = index_of(Recording(zeros, zeros, np.arange(6) * 2000, np.array(polarity, np.int8)))
    pairs = index.draw(np.array([5]), np.random.default_rng(0), 1000)
    assert (pairs.polarity_sum[0], pairs.event_count[0]) == (polarity_sum, event_count)
    assert pairs.variance[0] == 5 + 8 * (event_count - 5)


def test_missed_events_are_estimated_from_the_faster_neighbour():
    # A threshold takes 4 ms, except for the middle one, which takes 1 ms, the refractory period.
    pairs = spaced(np.array([5000, 2000, 5000])).draw(np.array([3]), np.random.default_rng(0), 1000)
    assert pairs.polarity_sum[0] == 3 + 2


def test_missed_events_before_a_silence_are_included():
    # As above; the pairs span the refractory periods after the second to last and the last event.
    index = spaced(np.full(9, 5000))
    pairs = index.draw_silent(5000, 3, (20_000, 39_999), np.random.default_rng(0), 1000)
    pairs = pairs.select(pairs.pixel == 0)
    assert np.allclose(pairs.polarity_sum, pairs.event_count * 1.0)
    assert np.allclose(pairs.event_count, np.round(pairs.event_count / 1.25) * 1.25)
    assert np.allclose(pairs.variance, pairs.event_count / 1.25 * (1 + 8 * 0.25))
    # Nothing follows the very last event to estimate from.
    after = index.draw_silent(500, 1, (45_000, 50_000), np.random.default_rng(0), 1000)
    after = after.select(after.pixel == 0)
    assert set(after.event_count.tolist()) == {0.0, 1.0}


def test_at_most_three_events_are_missed_at_a_time():
    pairs = spaced(np.full(10, 1001)).draw(np.array([9]), np.random.default_rng(0), 1000)
    assert (pairs.polarity_sum[0], pairs.event_count[0]) == pytest.approx((9 + 3 * 8, 9 + 3 * 8))
