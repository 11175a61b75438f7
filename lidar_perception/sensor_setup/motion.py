"""How the robot moves between two scans, seen from above: which way is ahead."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy.fft import irfft2, rfft2

CELL, HALF = 0.2, 40.0   # metres: of the picture from above
LOW, HIGH = 0.3, 3.0     # metres above the ground of what stands there
MIN_SHIFT = 0.3          # metres; less says no direction
CLEAR, BESIDE = 1.2, 5   # times as high is a peak as what is more than so many cells beside it
LOCKED, FEW_SCANS = 0.7, 5  # share of the scans, if there are so many, in which a cell is occupied
                         # that moves with the robot, as lines of a beam on a straight wall do
GAPS = (1, 2, 4, 8, 16)  # clouds from one to the one that it is compared with
AGREED = 0.8             # so long is the mean of the directions at least, 0 .. 1
STRAIGHT = 5.0           # degrees; what is not at its origin goes elsewhere where the base turns
ONE = 7.0                # degrees: error of a direction, at least: what stands around may lead all
                         # pairs of one place alike, as walls do


class Shift(NamedTuple):
    """How far a sensor moved from one scan to the next: forward and left in its own frame, m."""

    x: float
    y: float


Pairs = Mapping[tuple[int, int], Shift | None]  # by the numbers of two scans


class Ahead(NamedTuple):
    """Where the robot drives, or the x axis of its base looks: degrees from x, counter-clockwise,
    NaN where that is not known, and the error of that; pairs: of scans that tell; went: the longest
    shift, metres, NaN where most are not clear; unknown: why it is not known, "" where it is; base:
    whether it is the base's x axis, whichever way the robot drove."""

    degrees: float
    error: float
    pairs: int
    went: float
    unknown: str
    base: bool = False


def spectrum(picture: np.ndarray) -> np.ndarray:
    """Of a picture (see pictures_of) with as much of nothing beside it, for shift_between."""
    return rfft2(picture, (2 * len(picture), 2 * len(picture)))


def shift_between(before: np.ndarray, after: np.ndarray) -> Shift | None:
    """Of the spectra of two pictures: the shift of what stands there under which they agree best
    (correlation by FFT); None where no shift agrees clearly. A turn of a few degrees blurs it and
    does no harm: the shift is then that of the way between."""
    size = len(before)
    match = irfft2(before * np.conj(after))
    best = np.unravel_index(match.argmax(), match.shape)
    peak, elsewhere = match[best], match.copy()
    rows, columns = ((np.arange(-BESIDE, BESIDE + 1) + b) % size for b in best)
    elsewhere[np.ix_(rows, columns)] = 0.0
    if peak <= 0 or peak < CLEAR * elsewhere.max():
        return None
    x, y = ((int(b) + size // 2) % size - size // 2 + _summit(match, best, axis)
            for axis, b in enumerate(best))
    return Shift(x * CELL, y * CELL)


def _summit(match: np.ndarray, best: tuple[np.intp, ...], axis: int) -> float:
    """Of the parabola through a peak and its neighbours, cells beside the peak, -0.5 .. 0.5."""
    around = [list(best) for _ in range(3)]
    for cell, step in zip(around, (-1, 0, 1)):
        cell[axis] = (cell[axis] + step) % len(match)
    low, top, high = (float(match[tuple(cell)]) for cell in around)
    return 0.5 * (high - low) / bend if (bend := 2 * top - low - high) > 0 else 0.0


def pictures_of(scans: Sequence[np.ndarray], moves: bool) -> np.ndarray:
    """Of levelled points (N, 3) each, whose z is the height above the ground: (S, cells, cells)
    float32, 1 where something stands, but for what is LOCKED where the robot is known to move."""
    images = np.zeros((len(scans), *[int(2 * HALF / CELL)] * 2), np.float32)
    for image, xyz in zip(images, scans):
        stands = (xyz[:, 2] > LOW) & (xyz[:, 2] < HIGH) & (np.abs(xyz[:, :2]) < HALF).all(axis=1)
        cells = ((xyz[stands, :2] + HALF) / CELL).astype(int)
        image[cells[:, 0], cells[:, 1]] = 1.0
    if moves and len(scans) >= FEW_SCANS:
        images *= images.mean(axis=0) < LOCKED
    return images


def shifts_of(pictures: np.ndarray, numbers: Sequence[int]) -> Pairs:
    """Of pictures and their numbers in the recording: from each to the next of GAPS by which the
    robot has gone MIN_SHIFT, or as far as it went; None where that is not clear."""
    found: dict[tuple[int, int], Shift | None] = {}
    spectra = dict(zip(numbers, map(spectrum, pictures), strict=True))
    for number, before in spectra.items():
        others = [number + gap for gap in GAPS if number + gap in spectra]
        for other in others:
            shift = shift_between(before, spectra[other])
            if shift is None or np.hypot(*shift) >= MIN_SHIFT:
                break
        if others:
            found[number, other] = shift
    return found


def driven(poses: Mapping[int, np.ndarray], pairs: Pairs) -> Pairs:
    """By poses (4, 4) of the robot's base at scans: how far it went from one scan of a pair to the
    other, in its own frame; None where it turned by more than STRAIGHT. Pairs without poses are
    left out."""
    steps = {pair: np.linalg.solve(poses[pair[0]], poses[pair[1]]) for pair in pairs
             if set(pair) <= poses.keys()}
    return {pair: Shift(*map(float, step[:2, 3])) if abs(np.degrees(np.arctan2(
        step[1, 0], step[0, 0]))) <= STRAIGHT else None for pair, step in steps.items()}


def ahead_of(pairs: Pairs, base: Pairs) -> Ahead:
    """The mean direction of the shifts that tell one. base: how the robot's base went between the
    same scans, as driven() has it; then the direction is that of its x axis. Empty where that is
    not known."""
    every = np.array([complex(*shift) for shift in pairs.values() if shift is not None])
    far = {pair: complex(*shift) for pair, shift in pairs.items()
           if shift is not None and np.hypot(*shift) >= MIN_SHIFT}
    went = float(np.abs(every).max(initial=0.0))
    if not far and 2 * len(every) <= len(pairs):
        return Ahead(np.nan, np.nan, 0, np.nan, "what stands around is too little, or too much "
                     "alike, to see how the robot moved")
    if not far:
        return Ahead(np.nan, np.nan, 0, went, f"the robot moved only {went:.1f} m between the "
                     "clouds that were compared")
    by_base = {pair: far[pair] / complex(*step) for pair, step in base.items()
               if pair in far and step is not None and np.hypot(*step) >= MIN_SHIFT / 2}
    turns = np.array(list((by_base or far).values()))
    mean = complex((turns / np.abs(turns)).mean())
    agree = min(abs(mean), 1.0)
    if agree < AGREED:
        why = ("what the clouds and the odometry say of its way does not agree" if by_base else
               f"the robot turned, or drove to and fro: {len(turns)} shifts have different "
               "directions")
        return Ahead(np.nan, np.nan, len(turns), went, why, bool(by_base))
    error = max(float(np.degrees(np.sqrt(-2 * np.log(agree)) / np.sqrt(len(turns)))), ONE)
    return Ahead(float(np.degrees(np.angle(mean))), error, len(turns), went, "", bool(by_base))
