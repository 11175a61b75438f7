"""Measurement of a sensor and its mounting from clouds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidar_perception.robot.crop import select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.poses import invert_pose, transform_points
from lidar_perception.sensor_setup.measurement.beams import Beams, find_beams, measure_azimuth_step, measure_range_noise
from lidar_perception.sensor_setup.measurement.coverage import (
    Coverage,
    find_nearest_returns,
    is_stationary,
    measure_coverage,
)
from lidar_perception.sensor_setup.measurement.motion import (
    Heading,
    compute_shifts,
    compute_spectrum,
    draw_images,
    estimate_heading,
    find_shift,
    find_shifts,
)
from lidar_perception.sensor_setup.measurement.mount import Mount, is_on_ground, measure_mount
from lidar_perception.sensor_setup.measurement.recorded_poses import NO_POSES, RecordedPoses
from lidar_perception.sensor_setup.measurement.scans import IntensityScale, Scan, measure_intensity, require_3d
from lidar_perception.sensor_setup.measurement.timing import Timing, measure_timing
from lidar_perception.simulation.sensor import SENSOR_NAMES, find_sensor
from lidar_perception.types import InputError

MAX_MODEL_ERROR = 0.15  # maximum median difference between measured beams and those of a model, in degrees
# The same limit if beams are missing, as a fraction of the model's beam spacing; random beams differ by 1 / 4.
MAX_PARTIAL_ERROR = 1 / 6
MIN_SCANS = 5  # minimum number of scans to separate the robot from its surroundings
MIN_OUTDOOR_RANGE_M = 30.0  # maximum range below which a room limits the range, not the sensor
MAX_RAW_SPREAD = 0.01  # maximum deviation of the points of a beam in a raw cloud, in degrees
MIN_MOTION_M = 0.1  # minimum motion between scans of a robot that drives
MIN_POSE_MOTION_M = 2.0  # minimum extent of the recorded poses of a robot that drives; poses drift
PEOPLE_ELEVATIONS = (-15.0, 5.0)  # range of elevations of the beams that hit people, in degrees


class CloudSource(NamedTuple):
    """Scans for the measurement, with the name of their recording and its total number of clouds."""

    name: str
    scans: tuple[Scan, ...]
    total: int

    @property
    def frame_ids(self) -> list[str]:
        """Frames of the clouds, sorted, without empty ones."""
        return sorted({scan.frame_id for scan in self.scans} - {""})

    @property
    def has_few_scans(self) -> bool:
        """True if there are fewer than MIN_SCANS scans."""
        return len(self.scans) < MIN_SCANS


class ScanPattern(NamedTuple):
    """Scan pattern of the sensor.

    Attributes:
        beams: The beams; None if none were found.
        azimuth_step: Angle between two firings in degrees, NaN without beams.
        second_returns: Fraction of the points that are second returns.
        range_noise: Standard deviation of the range in metres, NaN if unknown.
        model: Sensor of config/sensors with the same beams, "" for none.
    """

    beams: Beams | None
    azimuth_step: float
    second_returns: float
    range_noise: float
    model: str

    @property
    def is_moved(self) -> bool:
        """True if points are not where the sensor measured them, for example after motion correction."""
        return self.beams is not None and float(np.median(self.beams.spread)) > MAX_RAW_SPREAD

    @property
    def prefers_model(self) -> bool:
        """True if the beams of the model are more reliable, because points were moved or beams have no returns."""
        if not self.model or self.beams is None:
            return False
        count, model_count = len(self.beams.elevations), find_sensor(self.model).rings
        return count < model_count or (self.is_moved and count == model_count)


class View(NamedTuple):
    """Coverage of the sensor, and the nearest and farthest return (m) outside the robot's body."""

    coverage: Coverage
    min_range: float
    max_range: float


class Mounting(NamedTuple):
    """Mounting of the sensor on the robot.

    Attributes:
        mount: Pose above the ground; None if unknown.
        on_ground: True if the origin of the clouds is on the ground, so that the mount is unknown.
        heading: Driving direction of the robot; None if no ground was found.
        recorded: Poses in the recording.
        height_hint: Height given by the user in metres; None if not given.
    """

    mount: Mount | None
    on_ground: bool
    heading: Heading | None
    recorded: RecordedPoses
    height_hint: float | None


@dataclass(frozen=True)
class SensorMeasurement:
    """Measured properties of a sensor. `intensity` is None if the clouds have no usable intensity."""

    source: CloudSource
    pattern: ScanPattern
    intensity: IntensityScale | None
    view: View
    mounting: Mounting
    timing: Timing

    @property
    def elevation_step(self) -> float:
        """Median spacing of the beams that hit people, in degrees; NaN without beams."""
        if self.pattern.beams is None:
            return np.nan
        elevations = self.pattern.beams.elevations
        if self.mounting.mount is not None and self.mounting.mount.upside_down:
            elevations = -elevations[::-1]
        low, high = PEOPLE_ELEVATIONS
        people_elevations = elevations[(elevations >= low) & (elevations <= high)]
        steps = -np.diff(people_elevations if len(people_elevations) > 2 else elevations)
        return float(np.median(steps)) if len(steps) else np.nan


def measure_sensor(
    scans: Sequence[Scan],
    numbers: Sequence[int],
    source: str,
    total: int,
    stamps_ns: np.ndarray | None,
    recorded: RecordedPoses = NO_POSES,
    height_hint: float | None = None,
) -> SensorMeasurement:
    """Measure a sensor and its mounting.

    Args:
        scans: Scans of the recording.
        numbers: Numbers of the scans in the recording.
        source: Name of the recording, for messages.
        total: Number of clouds in the recording.
        stamps_ns: Stamps of all clouds in the recording in ns; None if they have none.
        recorded: Poses in the recording.
        height_hint: Height of the sensor in metres, if known.

    Raises:
        InputError: The clouds have different columns, or come from a 2D scanner.
    """
    if len({scan.columns for scan in scans}) > 1:
        raise InputError(
            f"{source} has clouds with different columns ({', '.join(scans[0].columns)} "
            "and others), probably from several sensors; use the clouds of one sensor"
        )
    require_3d(np.concatenate([scan.elevation for scan in scans]), source)
    pattern = _measure_pattern(scans)
    mount = measure_mount(scans)
    nearest_returns = find_nearest_returns(scans, pattern.beams)
    # In uniform surroundings, such as a field, returns are constant although the robot moves.
    stationary = False if recorded.distance >= MIN_POSE_MOTION_M else is_stationary(nearest_returns.ranges)
    heading = _find_heading(scans, numbers, mount, stationary, recorded)
    # People and doors change the surroundings although the robot stands still.
    stationary = (
        True if len(scans) > 1 and _measure_distance(scans, mount, heading, recorded) < MIN_MOTION_M else stationary
    )
    view = _measure_view(scans, measure_coverage(scans, nearest_returns, mount, stationary))
    # Level beams are also in a plane through the origin.
    may_be_on_ground = mount is None and (pattern.beams is None or pattern.is_moved)
    return SensorMeasurement(
        CloudSource(source, tuple(scans), total),
        pattern,
        measure_intensity(scans),
        view,
        Mounting(mount, may_be_on_ground and is_on_ground(scans), heading, recorded, height_hint),
        measure_timing(scans, stamps_ns),
    )


def _measure_pattern(scans: Sequence[Scan]) -> ScanPattern:
    beams = find_beams(scans)
    step, second_returns, noise = np.nan, 0.0, np.nan
    if beams is not None:
        step, second_returns = measure_azimuth_step(scans, beams)
        noise = measure_range_noise(scans, beams, step)
    return ScanPattern(beams, step, second_returns, noise, find_matching_model(beams))


def _measure_view(scans: Sequence[Scan], coverage: Coverage) -> View:
    ranges = np.concatenate([s.range for s in scans])
    outside_ranges = ranges[
        select_points(
            np.concatenate([s.xyz for s in scans]),
            CropParams(body=tuple(coverage.box.tolist()) if coverage.can_crop else ()),
        )
    ]
    low, high = np.percentile(outside_ranges if len(outside_ranges) else ranges, [0.02, 99.995])
    return View(coverage, float(low), float(high))


def _find_heading(
    scans: Sequence[Scan], numbers: Sequence[int], mount: Mount | None, stationary: bool | None, recorded: RecordedPoses
) -> Heading | None:
    if mount is None:
        return None
    shifts = find_shifts(draw_images(_level_scans(scans, mount), is_moving=stationary is False), numbers)
    if recorded.base or not recorded.poses:
        return estimate_heading(shifts, compute_shifts(recorded.poses, shifts))
    # Odometry of the sensor gives its motion, but not the x axis of the base.
    sensor_from_level = invert_pose(mount.pose)
    poses = {number: sensor_pose @ sensor_from_level for number, sensor_pose in recorded.poses.items()}
    return estimate_heading(compute_shifts(poses, shifts), {})


def _level_scans(scans: Sequence[Scan], mount: Mount) -> list[np.ndarray]:
    return [transform_points(scan.xyz, mount.pose) for scan in scans]


def _measure_distance(
    scans: Sequence[Scan], mount: Mount | None, heading: Heading | None, recorded: RecordedPoses
) -> float:
    """Return the distance travelled in metres, NaN if unknown.

    Without recorded poses, this is the largest shift between neighbouring clouds, or between the
    first and the last cloud if that is larger.
    """
    distance = recorded.distance
    # If only some clouds have poses, the robot may have stood still during these.
    if len(recorded.poses) == len(scans) or distance >= MIN_MOTION_M:
        return distance
    if mount is None or heading is None:
        return np.nan
    end_scans = _level_scans([scans[0], scans[-1]], mount)
    shift = find_shift(*map(compute_spectrum, draw_images(end_scans, is_moving=False)))
    return np.nan if shift is None else float(np.maximum(heading.distance, np.hypot(*shift)))


def find_matching_model(beams: Beams | None) -> str:
    """Find the sensor in config/sensors with these beams, or most of them.

    Returns:
        Its name, "" if no sensor matches.
    """
    best, error = "", MAX_MODEL_ERROR
    if beams is None:
        return best
    for name in SENSOR_NAMES:
        elevations = np.degrees(find_sensor(name).elevations)
        if find_sensor(name).wander or not (0.75 <= len(beams.elevations) / len(elevations) <= 1.05):
            continue
        is_complete = len(beams.elevations) == len(elevations)
        difference = np.abs(
            beams.elevations - elevations if is_complete else np.abs(beams.elevations[:, None] - elevations).min(axis=1)
        )
        limit = error if is_complete else min(error, MAX_PARTIAL_ERROR * float(np.median(-np.diff(elevations))))
        if np.median(difference) < limit and np.percentile(difference, 90) < 5 * MAX_MODEL_ERROR:
            best, error = name, float(np.median(difference))
    return best
