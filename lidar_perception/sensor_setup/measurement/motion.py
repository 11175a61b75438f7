"""Motion of the robot between scans, from the correlation of bird's-eye images, and its heading."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.fft import irfft2, rfft2

from lidar_perception.geometry import wrap_angle

CELL_M, HALF_SIZE_M = 0.2, 40.0  # cell size and half width of the bird's-eye images
MIN_HEIGHT_M, MAX_HEIGHT_M = 0.3, 3.0  # heights above the ground of the points in the images
MIN_SHIFT_M = 0.3  # minimum shift with a reliable direction
MIN_PEAK_RATIO = 1.2  # minimum ratio of a peak to the rest of the correlation
PEAK_HALF_SIZE = 5  # half size of a peak, in cells
# With at least MIN_STATIC_SCANS scans, cells that are occupied in this fraction of them are ignored: they
# move with the robot, for example where a beam hits a straight wall.
STATIC_FRACTION, MIN_STATIC_SCANS = 0.7, 5
GAPS = (1, 2, 4, 8, 16)  # differences between the numbers of the compared clouds
MIN_AGREEMENT = 0.8  # minimum length of the mean direction vector, 0 to 1
MAX_STRAIGHT_TURN = 5.0  # maximum rotation in degrees; when the robot turns, an off-centre sensor moves sideways
MIN_ERROR = 7.0  # minimum error of the heading in degrees, because walls can bias all shifts in one place
MAX_OFF_AXIS = 10.0  # tolerance between x axis and heading in degrees, added to twice the error


class Shift(NamedTuple):
    """Motion of a sensor between two scans, in metres forward (x) and left (y) in its own frame."""

    x: float
    y: float


Shifts = Mapping[tuple[int, int], Shift | None]  # (scan, scan) -> shift, None if ambiguous


class Heading(NamedTuple):
    """Driving direction of the robot, or the x axis of its base.

    Attributes:
        degrees: Angle from the cloud's x axis, counter-clockwise; NaN if unknown.
        error: Standard error of the angle in degrees.
        distance: Longest shift in metres, NaN if most shifts are ambiguous.
        problem: Reason why the heading is unknown, "" if it is known.
        from_base: True if the heading is the x axis of the base, even if the robot drove backwards.
    """

    degrees: float
    error: float
    distance: float
    problem: str
    from_base: bool = False

    @property
    def is_off_axis(self) -> bool:
        """True if the x axis of the cloud does not point forward."""
        return not self.problem and abs(self.degrees) - 2 * self.error > MAX_OFF_AXIS

    @property
    def may_be_reversed(self) -> bool:
        """True if the heading may be opposite to the forward direction, because the robot drove backwards."""
        return not self.from_base and abs(self.degrees) > 180 - 2 * MAX_OFF_AXIS


def wrap_degrees(degrees: float | np.ndarray) -> Any:
    """Wrap angles in degrees to -180 .. 180."""
    return np.degrees(wrap_angle(np.radians(degrees)))


def compute_spectrum(image: np.ndarray) -> np.ndarray:
    """Return the zero-padded 2D spectrum of an image, for find_shift."""
    return rfft2(image, (2 * len(image), 2 * len(image)))


def find_shift(before: np.ndarray, after: np.ndarray) -> Shift | None:
    """Find the shift at which two images correlate best.

    A rotation by a few degrees between the scans blurs the correlation, but does not bias it.

    Args:
        before, after: Spectra of the images, see compute_spectrum.

    Returns:
        The shift; None if the correlation has no clear peak.
    """
    size = len(before)
    correlation = irfft2(before * np.conj(after))
    peak_cell = np.unravel_index(correlation.argmax(), correlation.shape)
    peak_value, rest = correlation[peak_cell], correlation.copy()
    rows, columns = ((np.arange(-PEAK_HALF_SIZE, PEAK_HALF_SIZE + 1) + b) % size for b in peak_cell)
    rest[np.ix_(rows, columns)] = 0.0
    if peak_value <= 0 or peak_value < MIN_PEAK_RATIO * rest.max():
        return None
    x, y = (
        (int(b) + size // 2) % size - size // 2 + _refine_peak(correlation, peak_cell, axis)
        for axis, b in enumerate(peak_cell)
    )
    return Shift(x * CELL_M, y * CELL_M)


def _refine_peak(correlation: np.ndarray, peak_cell: tuple[np.intp, ...], axis: int) -> float:
    """Return the offset of a peak in cells (-0.5 .. 0.5), from a parabola through its neighbours."""
    neighbours = [list(peak_cell) for _ in range(3)]
    for cell, step in zip(neighbours, (-1, 0, 1)):
        cell[axis] = (cell[axis] + step) % len(correlation)
    low, top, high = (float(correlation[tuple(cell)]) for cell in neighbours)
    return 0.5 * (high - low) / curvature if (curvature := 2 * top - low - high) > 0 else 0.0


def draw_images(scans: Sequence[np.ndarray], is_moving: bool) -> np.ndarray:
    """Draw bird's-eye images of the points above the ground.

    Args:
        scans: S arrays of points (N, 3) in a level frame, z = 0 on the ground.
        is_moving: True if the robot moves; clears cells that are occupied in most scans.

    Returns:
        (S, cells, cells) float32, 1 in occupied cells.
    """
    images = np.zeros((len(scans), *[int(2 * HALF_SIZE_M / CELL_M)] * 2), np.float32)
    for image, xyz in zip(images, scans):
        is_drawn = (
            (xyz[:, 2] > MIN_HEIGHT_M) & (xyz[:, 2] < MAX_HEIGHT_M) & (np.abs(xyz[:, :2]) < HALF_SIZE_M).all(axis=1)
        )
        cells = ((xyz[is_drawn, :2] + HALF_SIZE_M) / CELL_M).astype(int)
        image[cells[:, 0], cells[:, 1]] = 1.0
    if is_moving and len(scans) >= MIN_STATIC_SCANS:
        images *= images.mean(axis=0) < STATIC_FRACTION
    return images


def find_shifts(images: np.ndarray, numbers: Sequence[int]) -> Shifts:
    """Find the shift between each scan and a later one, the first with a shift of at least MIN_SHIFT_M.

    Args:
        images: (S, cells, cells) images from draw_images.
        numbers: Numbers of the clouds in the recording.

    Returns:
        Shift of each pair of clouds. If all shifts of a cloud are smaller, that over the longest gap.
    """
    shifts: dict[tuple[int, int], Shift | None] = {}
    spectra = dict(zip(numbers, map(compute_spectrum, images), strict=True))
    for number, spectrum in spectra.items():
        later_numbers = [number + gap for gap in GAPS if number + gap in spectra]
        for later in later_numbers:
            shift = find_shift(spectrum, spectra[later])
            if shift is None or np.hypot(*shift) >= MIN_SHIFT_M:
                break
        if later_numbers:
            shifts[number, later] = shift
    return shifts


def compute_shifts(poses: Mapping[int, np.ndarray], pairs: Shifts) -> Shifts:
    """Compute the shifts of the base between pairs of scans, in its own frame.

    Args:
        poses: Poses (4, 4) of the base by scan number.
        pairs: Pairs of scans. Pairs without poses are left out.

    Returns:
        Shift of each pair, None if the base turned by more than MAX_STRAIGHT_TURN.
    """
    steps = {pair: np.linalg.solve(poses[pair[0]], poses[pair[1]]) for pair in pairs if set(pair) <= poses.keys()}
    return {
        pair: Shift(*map(float, step[:2, 3]))
        if abs(np.degrees(np.arctan2(step[1, 0], step[0, 0]))) <= MAX_STRAIGHT_TURN
        else None
        for pair, step in steps.items()
    }


def estimate_heading(shifts: Shifts, base: Shifts) -> Heading:
    """Estimate the heading: the mean direction of all shifts of at least MIN_SHIFT_M.

    Args:
        shifts: Shifts of the sensor.
        base: Shifts of the base between the same scans, see compute_shifts. If it is not empty,
            the heading is the direction of the x axis of the base.
    """
    known_shifts = {pair: complex(*shift) for pair, shift in shifts.items() if shift is not None}
    long_shifts = {
        pair: shift for pair, shift in known_shifts.items() if np.hypot(shift.real, shift.imag) >= MIN_SHIFT_M
    }
    distance = float(np.abs(list(known_shifts.values())).max(initial=0.0))
    if not long_shifts and 2 * len(known_shifts) <= len(shifts):
        problem = "the surroundings have too few distinct features to measure the robot's motion"
        return Heading(np.nan, np.nan, np.nan, problem)
    if not long_shifts:
        problem = f"the robot moved only {distance:.1f} m between the compared clouds"
        return Heading(np.nan, np.nan, distance, problem)
    relative_to_base = {
        pair: long_shifts[pair] / complex(*step)
        for pair, step in base.items()
        if pair in long_shifts and step is not None and np.hypot(*step) >= MIN_SHIFT_M / 2
    }
    directions = np.array(list((relative_to_base or long_shifts).values()))
    mean = complex((directions / np.abs(directions)).mean())
    agreement = min(abs(mean), 1.0)
    if agreement < MIN_AGREEMENT:
        problem = (
            "the motion of the clouds does not agree with the odometry"
            if relative_to_base
            else f"the robot turned or drove back and forth: {len(directions)} shifts have different directions"
        )
        return Heading(np.nan, np.nan, distance, problem, bool(relative_to_base))
    error = max(float(np.degrees(np.sqrt(-2 * np.log(agreement)) / np.sqrt(len(directions)))), MIN_ERROR)
    return Heading(float(np.degrees(np.angle(mean))), error, distance, "", bool(relative_to_base))
