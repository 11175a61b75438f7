"""Confidence intervals of scores: the bootstrap over drives (Efron, 1979).

Frames of one drive show the same street and the same people, so drives are drawn with replacement,
not frames. A recording with fewer than MIN_DRIVES drives is divided into blocks of BLOCK_FRAMES
frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

MIN_DRIVES, BLOCK_FRAMES = 8, 10
INTERVAL_PERCENT = 90  # percentage of the draws inside an interval


def group_frames(names: Sequence[str], follow: bool = False) -> list[np.ndarray]:
    """Group frames, named DRIVE/FRAME, into the drives or blocks to draw from.

    Args:
        names: names of the frames.
        follow: True if frames without a drive are consecutive, as in a bag; they are then one
            drive. Otherwise each frame counts as one drive, as in KITTI's object layout.

    Returns:
        Indices of the frames of each group.
    """
    drives: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        drives.setdefault(name.rpartition("/")[0] or ("" if follow else f"/{i}"), []).append(i)
    if len(drives) >= MIN_DRIVES:
        return [*map(np.array, drives.values())]
    return [
        np.array(frames[i : i + BLOCK_FRAMES])
        for frames in drives.values()
        for i in range(0, len(frames), BLOCK_FRAMES)
    ]


def compute_interval(
    score: Callable[[np.ndarray], float | None], parts: Sequence[np.ndarray], count: int
) -> list[float] | None:
    """Return [low, high] of score(frames) over `count` draws of the groups in parts.

    frames (F,) are indices. Returns None for fewer than two groups, or if no draw has a score.
    """
    return compute_bounds(score(frames) for frames in draw_samples(parts, count))


def draw_samples(parts: Sequence[np.ndarray], count: int) -> Iterator[np.ndarray]:
    """Yield indices of frames (F,) for `count` draws with a fixed seed; none for one group."""
    rng = np.random.default_rng(0)
    for _ in range(count if len(parts) > 1 else 0):
        yield np.concatenate([parts[i] for i in rng.integers(len(parts), size=len(parts))])


def compute_bounds(scores: Iterable[float | None]) -> list[float] | None:
    """Return [low, high] of the central INTERVAL_PERCENT of the scores, None without any."""
    found = [score for score in scores if score is not None]
    if not found:
        return None
    limits = (100 - INTERVAL_PERCENT) / 2, (100 + INTERVAL_PERCENT) / 2
    return np.percentile(found, limits).round(2).tolist()
