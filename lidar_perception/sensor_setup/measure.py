"""Everything that clouds say of the sensor that made them, and of how it is mounted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidar_perception.robot.crop import select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.poses import invert_pose, transform_points
from lidar_perception.sensor_setup.beams import Beams, azimuth_steps, beams_of, range_noise
from lidar_perception.sensor_setup.coverage import Coverage, coverage_of, nearest_of, stands_still
from lidar_perception.sensor_setup.motion import (
    Ahead,
    ahead_of,
    driven,
    pictures_of,
    shift_between,
    shifts_of,
    spectrum,
)
from lidar_perception.sensor_setup.mount import Mount, mount_of, on_the_ground
from lidar_perception.sensor_setup.scans import Intensity, Scan, intensity_of, require_space
from lidar_perception.sensor_setup.timing import Timing, timing_of
from lidar_perception.sensor_setup.told import NOTHING, Told
from lidar_perception.simulation.sensor import NAMES, Sensor, sensor_named
from lidar_perception.types import InputError

SAME_MODEL = 0.15   # degrees between beams, the median, of sensors of one model
PART = 1 / 6        # of the space between its beams, likewise, of beams that are not as many: those
                    # of any sensor are a quarter of it from the nearest
FEW_SCANS = 5       # fewer say little of what is the robot's and what is the place's
SMALL_ROOM = 30.0   # metres: where nothing is farther, the room ends the range and not the sensor
TURNED = 0.01       # degrees by which points of a beam scatter, from which on they have been moved
HARDLY = 0.1        # metres: a robot that has gone less stands still
DROVE = 2.0         # metres by its poses, from which on it has moved; one that stands drifts less
AROUND = (-15.0, 5.0)  # degrees: where people are, in which the distance of beams is measured


@dataclass(frozen=True)
class Measured:
    """All of it. beams None where there are none, then step and noise are NaN; step: degrees;
    twice: share of second returns; noise: m, of noise_pieces; least, greatest: m, of what is not
    the robot's own; heading: where the robot drives, None without ground; model: the sensor
    of config/sensors with such beams, "" for none; model_error: degrees, the median over the
    beams; told: what the recording says itself; hint: the height that somebody knows, m;
    on_ground: whether the origin of the clouds lies on the ground, where no mount is known."""

    source: str
    scans: tuple[Scan, ...]
    total: int
    intensity: Intensity | None
    beams: Beams | None
    step: float
    twice: float
    noise: float
    noise_pieces: int
    coverage: Coverage
    mount: Mount | None
    heading: Ahead | None
    least: float
    greatest: float
    timing: Timing
    model: str
    model_error: float
    told: Told
    hint: float | None = None
    on_ground: bool = False

    @property
    def moved(self) -> bool:
        """Whether points are not where the sensor saw them, as after a correction for motion."""
        return self.beams is not None and float(np.median(self.beams.spread)) > TURNED

    @property
    def as_model(self) -> bool:
        """Whether the model's beams are surer than the measured ones, which agree with them: where
        points were moved, or some of the beams have too few of them."""
        if not self.model or self.beams is None:
            return False
        measured, known = len(self.beams.elevations), sensor_named(self.model).rings
        return measured < known or (self.moved and measured == known)

    @property
    def elevation_step(self) -> float:
        """Degrees between neighbouring beams, the median where people are; NaN without beams."""
        if self.beams is None:
            return np.nan
        up = self.beams.elevations
        if self.mount is not None and self.mount.upside_down:
            up = -up[::-1]
        middle = up[(up >= AROUND[0]) & (up <= AROUND[1])]
        apart = -np.diff(middle if len(middle) > 2 else up)
        return float(np.median(apart)) if len(apart) else np.nan


def measured(scans: Sequence[Scan], numbers: Sequence[int], source: str, total: int,
             stamps_ns: np.ndarray | None, told: Told = NOTHING,
             hint: float | None = None) -> Measured:
    """All that can be measured of scans, which are those of these numbers among total ones of the
    source; told: what that says itself; hint: the height that somebody knows, m. InputError for
    what is of several drivers, or sees in one plane only."""
    if len({scan.columns for scan in scans}) > 1:
        raise InputError(f"{source} has clouds of several layouts ({', '.join(scans[0].columns)} "
                         "and others), as of several sensors; give those of one")
    require_space(np.concatenate([scan.elevation for scan in scans]), source)
    beams = beams_of(scans)
    step, twice, noise, pieces = np.nan, 0.0, np.nan, 0
    if beams is not None:
        step, twice = azimuth_steps(scans, beams)
        noise, pieces = range_noise(scans, beams, step)
    mount = mount_of(scans)
    nearest = nearest_of(scans, beams)
    # Where all is alike, as on a field, what is around a robot that drives stays as it is.
    still = False if _posed(told) >= DROVE else stands_still(nearest.ranges)
    heading = _heading(scans, numbers, mount, still, told)
    # People who pass by, or doors, change what is around a robot that stands.
    still = True if len(scans) > 1 and _way(scans, mount, heading, told) < HARDLY else still
    coverage = coverage_of(scans, nearest, mount, still)
    ranges = np.concatenate([s.range for s in scans])
    away = ranges[select_points(np.concatenate([s.xyz for s in scans]), CropParams(
        body=tuple(coverage.box.tolist()) if coverage.fits else ()))]
    least, greatest = np.percentile(away if len(away) else ranges, [0.02, 99.995])
    model, error = model_of(beams)
    found = Measured(source, tuple(scans), total, intensity_of(scans), beams, step, twice, noise,
                     pieces, coverage, mount, heading, float(least), float(greatest),
                     timing_of(scans, stamps_ns), model, error, told, hint)
    # A sensor's own level beams lie in a plane through its origin, too.
    return found if mount is not None or (beams is not None and not found.moved) else replace(
        found, on_ground=on_the_ground(scans))


def _heading(scans: Sequence[Scan], numbers: Sequence[int], mount: Mount | None,
             still: bool | None, told: Told) -> Ahead | None:
    if mount is None:
        return None
    shifts = shifts_of(pictures_of(_levelled(scans, mount), moves=still is False), numbers)
    if told.base or not told.poses:
        return ahead_of(shifts, driven(told.poses, shifts))
    # Odometry of the sensor itself says no base's x, but where it went.
    level = invert_pose(mount.pose)
    return ahead_of(driven({number: sensor @ level for number, sensor in told.poses.items()},
                           shifts), {})


def _levelled(scans: Sequence[Scan], mount: Mount) -> list[np.ndarray]:
    return [transform_points(scan.xyz, mount.pose) for scan in scans]


def _way(scans: Sequence[Scan], mount: Mount | None, heading: Ahead | None, told: Told) -> float:
    """Metres that the robot went, by its poses, else between the clouds that were compared, and
    from the first to the last: it may be slow. NaN where that is not clear."""
    went = _posed(told)
    if len(told.poses) == len(scans) or went >= HARDLY:  # poses of a part may be of a halt
        return went
    if mount is None or heading is None:
        return np.nan
    ends = _levelled([scans[0], scans[-1]], mount)
    shift = shift_between(*map(spectrum, pictures_of(ends, moves=False)))
    return np.nan if shift is None else float(np.maximum(heading.went, np.hypot(*shift)))


def _posed(told: Told) -> float:
    """Metres that the robot went by its poses; NaN without any."""
    return float(np.ptp([pose[:2, 3] for pose in told.poses.values()], axis=0).max()
                 ) if told.poses else np.nan


def model_of(beams: Beams | None) -> tuple[str, float]:
    """Which of config/sensors has these beams, or most of them; "" for none. Degrees between its
    beams and these, the median."""
    best, error = "", SAME_MODEL
    if beams is None:
        return best, np.nan
    for name in NAMES:
        known = np.degrees(sensor_named(name).elevations)
        if sensor_named(name).wander or not 0.75 <= len(beams.elevations) / len(known) <= 1.05:
            continue
        alike = len(beams.elevations) == len(known)
        off = np.abs(beams.elevations - known if alike else
                     np.abs(beams.elevations[:, None] - known).min(axis=1))
        limit = error if alike else min(error, PART * float(np.median(-np.diff(known))))
        if np.median(off) < limit and np.percentile(off, 90) < 5 * SAME_MODEL:
            best, error = name, float(np.median(off))
    return best, error if best else np.nan


def sensor_of(found: Measured) -> Sensor:
    """What was measured as a sensor that can be simulated, as it hangs where it is upside down.
    What clouds do not say, such as the divergence of the beams, is that of the model with the same
    beams, or the default. Without beams there is a grid of the same view whose beams wander, with
    as many points in a turn."""
    sensor = _in_its_frame(found)
    return sensor if found.mount is None or not found.mount.upside_down else _turned_over(sensor)


def _turned_over(sensor: Sensor) -> Sensor:
    """The sensor turned about its x axis by half a circle; its sectors are of all beams."""
    return replace(
        sensor, elevations=tuple(sensor.wander - up for up in reversed(sensor.elevations)),
        lifts=tuple(-lift for lift in reversed(sensor.lifts)),
        blocked=tuple((first, -end % 360, -start % 360 or 360.0)
                      for first, start, end in sensor.blocked))


def _in_its_frame(found: Measured) -> Sensor:
    known = sensor_named(found.model) if found.model else None
    fields: dict[str, Any] = {} if known is None else {name: getattr(known, name) for name in (
        "divergence", "reach", "pulse", "min_range", "max_range", "range_noise", "rate", "silent",
        "floor", "fade")}
    if found.intensity is None:
        fields["silent"] = 1.0
    if np.isfinite(found.noise):
        fields["range_noise"] = round(found.noise, 4)
    if found.greatest > SMALL_ROOM or known is None:
        fields["max_range"] = float(np.ceil(max(found.greatest, SMALL_ROOM)))
    fields["rate"] = round(found.timing.rate, 2) if np.isfinite(found.timing.rate) else fields.get(
        "rate", 10.0)
    if found.mount is not None or found.hint is not None:
        fields["height"] = found.hint if found.mount is None else round(found.mount.height, 3)
    # The nearest thing may be far away, as the ground is, and nearer than the model's data sheet.
    least = fields.get("min_range", Sensor.min_range)
    if found.least < least:
        fields["min_range"] = float(np.floor(100 * found.least) / 100)
    if found.beams is None:
        return _grid(found, fields)
    # What one place hides is not what the robot hides: there only the ends of the view count, and
    # so they do where lower beams do not look lower.
    places = found.coverage.still is False and len(found.scans) >= FEW_SCANS and (
        found.mount is not None and found.mount.level)
    fields["blocked"] = tuple(b for b in found.coverage.blocked if places or b[0] == 0)
    up, lifts = np.radians(np.round(found.beams.elevations, 4)), np.round(found.beams.lifts, 4)
    if found.as_model and known is not None:
        fields["blocked"] = tuple(
            (first and int(np.abs(np.array(known.elevations) - up[first]).argmin()), start, end)
            for first, start, end in fields["blocked"])
        up, lifts = np.array(known.elevations), np.array(known.lifts)
    if lifts.any():
        fields["lifts"] = tuple(lifts.tolist())
    step = found.step if np.isfinite(found.step) else 0.2
    return Sensor(tuple(up.tolist()), float(np.radians(step)), **fields)


def _grid(found: Measured, fields: dict[str, Any]) -> Sensor:
    up = np.concatenate([scan.elevation for scan in found.scans])
    high, low = np.percentile(up, [99.8, 0.2])
    points = np.median([len(scan.xyz) for scan in found.scans])
    start, end = found.coverage.view
    share = ((end - start) % 360 or 360) / 360
    rows = int(np.clip(np.sqrt(points / share * (high - low) / 360), 4, 128))
    gap = (high - low) / rows
    columns = int(np.clip(points / share / rows, 90, 4000))
    if share < 1:
        fields["blocked"] = ((0, end, start),)
    return Sensor(tuple(np.radians(high - gap * np.arange(rows)).tolist()), 2 * np.pi / columns,
                  wander=float(np.radians(gap)), **fields)
