"""Motion of the robot between scans, seen from above, and its heading in the sensor's frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import irfft2, rfft2

from lidar_perception.geometry import wrap_angle

CELL_M, HALF_SIZE_M = 0.2, 40.0  # cell size and half width of the BEV images
LOW_M, HIGH_M = 0.3, 3.0  # heights above the ground of the points in these images
MIN_SHIFT_M = 0.3  # minimum shift that gives a direction
MIN_PEAK_RATIO = 1.2  # minimum ratio of a clear peak to the rest of the correlation
PEAK_HALF_SIZE = 5  # cells around a peak that are excluded from the rest
# Cells occupied in this fraction of the scans move with the robot, like lines of a beam on a straight
# wall do. Only with this many scans.
LOCKED_SHARE, MIN_LOCKED_SCANS = 0.7, 5
GAPS = (1, 2, 4, 8, 16)  # index differences between the clouds that are compared
MIN_AGREEMENT = 0.8  # minimum length of the mean direction vector, 0 to 1
MAX_STRAIGHT_TURN = 5.0  # max rotation between scans in degrees; in turns, an off-centre sensor moves sideways
MIN_ERROR = 7.0  # minimum error in degrees, since walls can mislead all pairs of one place
MAX_OFF_AXIS = 10.0  # tolerance between x axis and heading in degrees, added to twice the error


class Shift(NamedTuple):
    """Motion of a sensor from one scan to another: m forward and left in its own frame."""

    x: float
    y: float


Shifts = Mapping[tuple[int, int], Shift | None]  # (scan, scan) -> shift, None if unclear


class Heading(NamedTuple):
    """Direction in which the robot drives, or the x axis of its base.

    Attributes:
        degrees: Angle from the cloud's x axis, counter-clockwise; NaN if unknown.
        error: Standard error of the angle in degrees.
        distance: Longest shift in metres, NaN if most are not clear.
        problem: Why the heading is unknown, "" if it is known.
        from_base: It is the base's x axis, in whichever direction the robot drove.
    """

    degrees: float
    error: float
    distance: float
    problem: str
    from_base: bool = False

    @property
    def is_off_axis(self) -> bool:
        """True if the cloud's x axis does not point ahead."""
        return not self.problem and abs(self.degrees) - 2 * self.error > MAX_OFF_AXIS

    @property
    def may_be_reversed(self) -> bool:
        """True if x may point ahead although is_off_axis, because the robot drove backwards."""
        return not self.from_base and abs(self.degrees) > 180 - 2 * MAX_OFF_AXIS


def wrap_degrees(degrees: float | np.ndarray) -> Any:
    """Wrap degrees to -180 .. 180."""
    return np.degrees(wrap_angle(np.radians(degrees)))


def compute_spectrum(image: np.ndarray) -> np.ndarray:
    """Return the zero-padded spectrum of an image of draw_images, for find_shift."""
    return rfft2(image, (2 * len(image), 2 * len(image)))


def find_shift(before: np.ndarray, after: np.ndarray) -> Shift | None:
    """Return the shift between two images at which they agree best (correlation by FFT).

    A turn by a few degrees blurs the correlation but does no harm: the shift then is that of the
    path between the scans.

    Args:
        before, after: Spectra of the images.

    Returns:
        The shift; None if no shift agrees clearly.
    """
    size = len(before)
    match = irfft2(before * np.conj(after))
    best = np.unravel_index(match.argmax(), match.shape)
    peak, rest = match[best], match.copy()
    rows, columns = ((np.arange(-PEAK_HALF_SIZE, PEAK_HALF_SIZE + 1) + b) % size for b in best)
    rest[np.ix_(rows, columns)] = 0.0
    if peak <= 0 or peak < MIN_PEAK_RATIO * rest.max():
        return None
    x, y = ((int(b) + size // 2) % size - size // 2 + _refine_peak(match, best, axis) for axis, b in enumerate(best))
    return Shift(x * CELL_M, y * CELL_M)


def _refine_peak(match: np.ndarray, best: tuple[np.intp, ...], axis: int) -> float:
    """Return the offset of a parabola through a peak and its neighbours, in cells, -0.5 .. 0.5."""
    around = [list(best) for _ in range(3)]
    for cell, step in zip(around, (-1, 0, 1)):
        cell[axis] = (cell[axis] + step) % len(match)
    low, top, high = (float(match[tuple(cell)]) for cell in around)
    return 0.5 * (high - low) / bend if (bend := 2 * top - low - high) > 0 else 0.0


def draw_images(scans: Sequence[np.ndarray], moves: bool) -> np.ndarray:
    """Draw points above the ground as images from above.

    Args:
        scans: S arrays of points (N, 3) in the level frame, z = 0 on the ground.
        moves: The robot is known to move, so that cells occupied in most scans are left out.

    Returns:
        (S, cells, cells) float32, 1 in occupied cells.
    """
    images = np.zeros((len(scans), *[int(2 * HALF_SIZE_M / CELL_M)] * 2), np.float32)
    for image, xyz in zip(images, scans):
        drawn = (xyz[:, 2] > LOW_M) & (xyz[:, 2] < HIGH_M) & (np.abs(xyz[:, :2]) < HALF_SIZE_M).all(axis=1)
        cells = ((xyz[drawn, :2] + HALF_SIZE_M) / CELL_M).astype(int)
        image[cells[:, 0], cells[:, 1]] = 1.0
    if moves and len(scans) >= MIN_LOCKED_SCANS:
        images *= images.mean(axis=0) < LOCKED_SHARE
    return images


def find_shifts(images: np.ndarray, numbers: Sequence[int]) -> Shifts:
    """Return the shift from each scan to a later one, over the first of GAPS with MIN_SHIFT_M.

    Args:
        images: Images of draw_images.
        numbers: Numbers of their clouds in the recording.

    Returns:
        Shifts by pairs of numbers. If the robot moves less, the longest gap counts.
    """
    shifts: dict[tuple[int, int], Shift | None] = {}
    spectra = dict(zip(numbers, map(compute_spectrum, images), strict=True))
    for number, before in spectra.items():
        others = [number + gap for gap in GAPS if number + gap in spectra]
        for other in others:
            shift = find_shift(before, spectra[other])
            if shift is None or np.hypot(*shift) >= MIN_SHIFT_M:
                break
        if others:
            shifts[number, other] = shift
    return shifts


def compute_shifts(poses: Mapping[int, np.ndarray], pairs: Shifts) -> Shifts:
    """Return the shifts of the base between pairs of scans, in its own frame, from its poses.

    Args:
        poses: (4, 4) poses of the base by number of the scan.
        pairs: Pairs of scans; those without poses are left out.

    Returns:
        Shifts, None if the base turned by more than MAX_STRAIGHT_TURN.
    """
    steps = {pair: np.linalg.solve(poses[pair[0]], poses[pair[1]]) for pair in pairs if set(pair) <= poses.keys()}
    return {
        pair: Shift(*map(float, step[:2, 3]))
        if abs(np.degrees(np.arctan2(step[1, 0], step[0, 0]))) <= MAX_STRAIGHT_TURN
        else None
        for pair, step in steps.items()
    }


def estimate_heading(shifts: Shifts, base: Shifts) -> Heading:
    """Return the mean direction of the shifts that are long enough.

    Args:
        shifts: Shifts of the sensor.
        base: Shifts of the base between the same scans, see compute_shifts; empty if unknown. With
            them, the heading is the direction of the base's x axis.
    """
    every = np.array([complex(*shift) for shift in shifts.values() if shift is not None])
    far = {
        pair: complex(*shift) for pair, shift in shifts.items() if shift is not None and np.hypot(*shift) >= MIN_SHIFT_M
    }
    distance = float(np.abs(every).max(initial=0.0))
    if not far and 2 * len(every) <= len(shifts):
        return Heading(
            np.nan,
            np.nan,
            np.nan,
            "the surroundings have too few features, or too similar ones, to see how the robot moved",
        )
    if not far:
        return Heading(
            np.nan, np.nan, distance, f"the robot moved only {distance:.1f} m between the clouds that were compared"
        )
    by_base = {
        pair: far[pair] / complex(*step)
        for pair, step in base.items()
        if pair in far and step is not None and np.hypot(*step) >= MIN_SHIFT_M / 2
    }
    turns = np.array(list((by_base or far).values()))
    mean = complex((turns / np.abs(turns)).mean())
    agreement = min(abs(mean), 1.0)
    if agreement < MIN_AGREEMENT:
        problem = (
            "the motion in the clouds and in the odometry does not agree"
            if by_base
            else f"the robot turned, or drove to and fro: {len(turns)} shifts have different directions"
        )
        return Heading(np.nan, np.nan, distance, problem, bool(by_base))
    error = max(float(np.degrees(np.sqrt(-2 * np.log(agreement)) / np.sqrt(len(turns)))), MIN_ERROR)
    return Heading(float(np.degrees(np.angle(mean))), error, distance, "", bool(by_base))
