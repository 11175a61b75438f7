"""Confidence intervals: drives are resampled, not frames; constant scores have no width."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.scoring.centres.scores import CentreScores
from lidar_perception.scoring.intervals import BLOCK_FRAMES, MIN_DRIVES, compute_interval, group_frames


@given(st.lists(st.integers(0, 30), min_size=1, max_size=15), st.booleans())
def test_blocks_partition_the_frames_of_each_drive(lengths, named):
    names = [
        f"{drive:04}/{i:06}" if named else f"{drive}{i:06}" for drive, count in enumerate(lengths) for i in range(count)
    ]
    parts = group_frames(names)
    assert sorted(np.concatenate([np.zeros(0, int), *parts]).tolist()) == [*range(len(names))]
    for part in parts:
        drives = {names[i].rpartition("/")[0] for i in part}
        assert len(drives) == 1 and (named or len(part) == 1)
    drives = sum(count > 0 for count in lengths)
    if named and drives >= MIN_DRIVES:
        assert len(parts) == drives
    else:
        assert all(len(part) <= BLOCK_FRAMES for part in parts)


@given(st.integers(1, 45))
def test_bag_with_frames_named_by_time_is_one_drive(count):
    times, sequence_names = [f"{10**9 * i}" for i in range(count)], [f"0000/{i}" for i in range(count)]
    assert [*map(list, group_frames(times, sequential=True))] == [*map(list, group_frames(sequence_names))]


@given(st.integers(0, 2**32 - 1), st.integers(2, 40))
def test_interval_contains_score_and_is_repeatable(seed, count):
    values = np.random.default_rng(seed).normal(0, 1, count)
    parts = [np.array([i]) for i in range(count)]
    low, high = compute_interval(lambda frames: values[frames].mean(), parts, 300)
    assert low - 0.01 <= values.mean() <= high + 0.01
    assert [low, high] == compute_interval(lambda frames: values[frames].mean(), parts, 300)
    assert compute_interval(lambda frames: 3.0, parts, 10) == [3.0, 3.0]
    assert compute_interval(lambda frames: 3.0, parts[:1], 10) is None
    assert compute_interval(lambda frames: None, parts, 10) is None


def test_repeated_frames_of_a_drive_keep_interval_wide():
    """Ten equal frames of a drive have no more information than one."""
    person, elsewhere = np.array([[10.0, 0, 0, 1, 1, 2, 0]]), np.array([[20.0, 0, 0, 1, 1, 2, 0]])
    once, often = CentreScores(), CentreScores()
    for drive in range(12):
        found = person if drive % 2 else elsewhere
        once.update(person, found, np.ones(1), f"{drive}/0")
        for i in range(10):
            often.update(person, found, np.ones(1), f"{drive}/{i}")
    assert once.compute_f1_interval(0.5, 200) == often.compute_f1_interval(0.5, 200)
    low, high = once.compute_f1_interval(0.5, 200)
    assert low < 50 < high
