import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ebarf_ns.errors import RecordingError
from ebarf_ns.events.pairs import accumulate, batch_random, draw_steps, heldout_blocks, split_pairs
from ebarf_ns.events.recording import Recording

WIDTH, HEIGHT = 4, 3


def recording(seed: int, count: int) -> Recording:
    random = np.random.default_rng(seed)
    return Recording(
        random.integers(0, WIDTH, count).astype(np.uint16),
        random.integers(0, HEIGHT, count).astype(np.uint16),
        np.sort(random.integers(0, 1000, count)).astype(np.int64),
        random.choice([-1, 1], count).astype(np.int8),
    )


def nothing_heldout(events: Recording) -> np.ndarray:
    return np.zeros(len(events), bool)


def by_pixel(events: Recording) -> dict[int, list[int]]:
    found: dict[int, list[int]] = {}
    for i in range(len(events)):
        found.setdefault(int(events.y[i]) * WIDTH + int(events.x[i]), []).append(i)
    return found


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.integers(30, 200), st.integers(1, 5))
def test_every_pair_is_what_the_stream_says(seed: int, count: int, steps: int):
    events = recording(seed, count)
    index, _ = split_pairs(events, WIDTH, HEIGHT, nothing_heldout(events))
    steps = min(steps, index.max_steps)
    pairs = index.sample(np.full(300, steps), np.random.default_rng(seed))
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


def test_pairs_are_drawn_uniformly_and_all_of_them():
    events = recording(1, 60)
    index, _ = split_pairs(events, WIDTH, HEIGHT, nothing_heldout(events))
    for steps in (1, 3):
        expected = sum(max(0, len(rows) - steps) for rows in by_pixel(events).values())
        assert index.pairs_by_steps[steps] == expected
        last = index.ends[np.random.default_rng(0).integers(index.pairs_by_steps[np.full(200 * expected, steps)])]
        counts = np.bincount(last)[np.unique(last)]
        assert len(counts) == expected
        # 200 draws a pair on average: five standard deviations.
        assert np.abs(counts - 200).max() < 5 * np.sqrt(200)


def test_heldout_pairs_end_inside_and_training_pairs_stay_outside():
    events = recording(2, 400)
    heldout = heldout_blocks(events.t_us, 0.3, blocks=4)
    assert 0.15 < heldout.mean() < 0.45
    training, kept_back = split_pairs(events, WIDTH, HEIGHT, heldout)
    times = set(events.t_us[heldout].tolist()) - set(events.t_us[~heldout].tolist())
    random = np.random.default_rng(0)
    drawn = training.sample(draw_steps(500, 10, random), random)
    assert not times & (set(drawn.t0_us.tolist()) | set(drawn.t1_us.tolist()))
    drawn = kept_back.sample(draw_steps(500, 10, random), random)
    assert set(drawn.t1_us.tolist()) <= set(events.t_us[heldout].tolist())


def test_training_pairs_across_a_heldout_block_count_the_events_in_it():
    t = np.arange(5, dtype=np.int64)
    ones = np.ones(5, np.int8)
    events = Recording(np.zeros(5, np.uint16), np.zeros(5, np.uint16), t, ones)
    training, _ = split_pairs(events, WIDTH, HEIGHT, np.array([False, False, True, True, False]))
    pairs = training.sample(np.ones(50, np.int64), np.random.default_rng(0))
    across = pairs.t1_us == 4
    assert (pairs.polarity_sum[across] == 3).all() and (pairs.event_count[across] == 3).all()


def test_a_batch_depends_on_seed_and_number_alone():
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


def test_no_second_event_anywhere_is_an_error():
    events = Recording(
        np.arange(4, dtype=np.uint16), np.zeros(4, np.uint16), np.arange(4, dtype=np.int64), np.ones(4, np.int8)
    )
    with pytest.raises(RecordingError, match="no pair to train on"):
        split_pairs(events, WIDTH, HEIGHT, nothing_heldout(events))


def test_accumulated_picture_shows_polarity():
    events = Recording(
        np.array([1, 1, 2], np.uint16), np.array([0, 0, 1], np.uint16), np.arange(3, dtype=np.int64),
        np.array([1, 1, -1], np.int8),
    )  # fmt: skip
    picture = accumulate(events, WIDTH, HEIGHT)
    assert picture[0, 1] > 128 > picture[1, 2] and picture[2, 3] == 128
