"""How far a score may be off by the choice of frames: the bootstrap over drives (Efron, 1979).

Frames of one drive show the same street and the same people, so drives are drawn, not frames: as
many as there are, with replacement. Where a recording has fewer than DRIVES of them, runs of RUN
frames of a drive take their place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

MIN_DRIVES, BLOCK_FRAMES = 8, 10
INTERVAL_PERCENT = 90  # percent of the resamplings that lie within an interval


def group_frames(names: Sequence[str], follow: bool = False) -> list[np.ndarray]:
    """Indices of the frames with these names that belong together, DRIVE/FRAME. Frames without a
    drive are one drive where they follow each other, as in a bag; else each is one of its own, as
    in KITTI's object layout."""
    drives: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        drives.setdefault(name.rpartition("/")[0] or ("" if follow else f"/{i}"), []).append(i)
    if len(drives) >= MIN_DRIVES:
        return [*map(np.array, drives.values())]
    return [np.array(frames[i:i + BLOCK_FRAMES]) for frames in drives.values()
            for i in range(0, len(frames), BLOCK_FRAMES)]


def compute_interval(
    score: Callable[[np.ndarray], float | None], parts: Sequence[np.ndarray], count: int
) -> list[float] | None:
    """[low, high] of what score(frames) gives for `count` drawings of these parts; frames (F,) are
    indices. None where fewer than two parts were drawn from, or no drawing has a score."""
    return compute_bounds(score(frames) for frames in draw_samples(parts, count))


def draw_samples(parts: Sequence[np.ndarray], count: int) -> Iterator[np.ndarray]:
    """(F,) indices of frames, `count` times, always the same; none of fewer than two parts."""
    rng = np.random.default_rng(0)
    for _ in range(count if len(parts) > 1 else 0):
        yield np.concatenate([parts[i] for i in rng.integers(len(parts), size=len(parts))])


def compute_bounds(scores: Iterable[float | None]) -> list[float] | None:
    """[low, high] that hold SHARE percent of the scores; None where there is none."""
    found = [score for score in scores if score is not None]
    if not found:
        return None
    return (
        np.percentile(found, [(100 - INTERVAL_PERCENT) / 2, (100 + INTERVAL_PERCENT) / 2])
        .round(2)
        .tolist()
    )
