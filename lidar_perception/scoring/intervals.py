"""Confidence intervals of scores: the bootstrap over drives (Efron, 1979).

Frames of one drive show the same street and the same people. Therefore, drives are drawn with
replacement, not frames. A recording with fewer than MIN_DRIVES drives is divided into blocks of
BLOCK_FRAMES frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

MIN_DRIVES, BLOCK_FRAMES = 8, 10
INTERVAL_PERCENT = 90  # percentage of the draws inside an interval


def group_frames(names: Sequence[str], sequential: bool = False) -> list[np.ndarray]:
    """Group frames into drives or blocks, from which the bootstrap draws.

    Args:
        names: Names of the frames, DRIVE/FRAME.
        sequential: True if frames without a drive name are consecutive, as in a bag; they form one
            drive. Otherwise each of them counts as its own drive, as in KITTI's object layout.

    Returns:
        Frame indices of each group.
    """
    drives: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        drives.setdefault(name.rpartition("/")[0] or ("" if sequential else f"/{i}"), []).append(i)
    if len(drives) >= MIN_DRIVES:
        return [*map(np.array, drives.values())]
    return [
        np.array(frames[i : i + BLOCK_FRAMES])
        for frames in drives.values()
        for i in range(0, len(frames), BLOCK_FRAMES)
    ]


def compute_interval(
    score: Callable[[np.ndarray], float | None], groups: Sequence[np.ndarray], count: int
) -> list[float] | None:
    """Compute the bootstrap interval [low, high] of a score.

    Args:
        score: Function of frame indices (F,) that returns a score, or None if there is none.
        groups: Frame indices of each drive or block, see group_frames.
        count: Number of bootstrap draws.

    Returns:
        The interval; None for fewer than two groups, or if no draw has a score.
    """
    return compute_bounds(score(frames) for frames in draw_samples(groups, count))


def draw_samples(groups: Sequence[np.ndarray], count: int) -> Iterator[np.ndarray]:
    """Yield the frame indices (F,) of `count` bootstrap draws with a fixed seed. Nothing for one group."""
    rng = np.random.default_rng(0)
    for _ in range(count if len(groups) > 1 else 0):
        yield np.concatenate([groups[i] for i in rng.integers(len(groups), size=len(groups))])


def compute_bounds(scores: Iterable[float | None]) -> list[float] | None:
    """Return the bounds [low, high] of the central INTERVAL_PERCENT of the scores.

    Scores of None are ignored. Returns None if no score remains.
    """
    values = [score for score in scores if score is not None]
    if not values:
        return None
    limits = (100 - INTERVAL_PERCENT) / 2, (100 + INTERVAL_PERCENT) / 2
    return np.percentile(values, limits).round(2).tolist()
