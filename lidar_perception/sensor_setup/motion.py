"""How the robot moves between two scans, seen from above: which way is ahead."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

CELL, HALF = 0.2, 40.0   # metres: of the picture from above
LOW, HIGH = 0.3, 3.0     # metres above the ground of what stands there
MIN_SHIFT = 0.3          # metres; less says no direction
MIN_PEAK = 2.0           # times as high as what is elsewhere


class Shift(NamedTuple):
    """How far a sensor moved from one scan to the next: forward and left in its own frame, m."""

    x: float
    y: float


def shift_between(before: np.ndarray, after: np.ndarray) -> Shift | None:
    """Of levelled points (N, 3), (M, 3) whose z is the height above the ground: the shift of what
    stands there under which both pictures agree best (correlation by FFT), to a cell; None where
    no shift agrees clearly. A turn of a few degrees blurs it and does no harm."""
    images = [_picture(xyz) for xyz in (before, after)]
    size = images[0].shape[0]
    product = np.fft.rfft2(images[0], (2 * size, 2 * size)) * np.conj(
        np.fft.rfft2(images[1], (2 * size, 2 * size)))
    match = np.fft.irfft2(product)
    best = np.unravel_index(match.argmax(), match.shape)
    peak = match[best]
    around = match.copy()
    rows = (np.arange(-5, 6) + best[0]) % match.shape[0]
    columns = (np.arange(-5, 6) + best[1]) % match.shape[1]
    around[np.ix_(rows, columns)] = 0.0
    if peak <= 0 or peak < MIN_PEAK * np.percentile(around, 99.9):
        return None
    moved = [(int(b) + size) % (2 * size) - size for b in best]
    return Shift(moved[0] * CELL, moved[1] * CELL)


def _picture(xyz: np.ndarray) -> np.ndarray:
    """(cells, cells) float32, 1 where something stands."""
    stands = (xyz[:, 2] > LOW) & (xyz[:, 2] < HIGH) & (np.abs(xyz[:, :2]) < HALF).all(axis=1)
    cells = ((xyz[stands, :2] + HALF) / CELL).astype(int)
    image = np.zeros((int(2 * HALF / CELL),) * 2, np.float32)
    image[cells[:, 0], cells[:, 1]] = 1.0
    return image


def heading_of(shifts: list[Shift]) -> tuple[float, float] | None:
    """Degrees from x to where the robot drives, as the mean over shifts, and how much they agree,
    0 .. 1; None where no shift says a direction."""
    ways = np.array([[s.x, s.y] for s in shifts if np.hypot(s.x, s.y) >= MIN_SHIFT])
    if not len(ways):
        return None
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    mean = ways.mean(axis=0)
    return float(np.degrees(np.arctan2(mean[1], mean[0]))), float(np.linalg.norm(mean))
