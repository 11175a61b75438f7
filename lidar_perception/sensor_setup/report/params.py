"""Choice of node parameters for a measured sensor, each with its reason."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.clustering.density import adapt_to_density
from lidar_perception.clustering.params import FULL_DENSITY, ClusteringParams
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.robot.poses import transform_points
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.sensor_setup.measurement.motion import MAX_OFF_AXIS, wrap_degrees
from lidar_perception.sensor_setup.measurement.mount import Mount
from lidar_perception.sensor_setup.measurement.recorded_poses import FOOTPRINT
from lidar_perception.types import InputError

Choices = dict[str, tuple[Any, str]]  # parameter name -> (value, reason)

# DBSCAN radius at the end of a range band, as a multiple of the beam spacing there. The paper's values (0.15,
# 0.30 and 0.50 m up to 15, 30 and 45 m) have this ratio for the HDL-64E.
EPS_RATIO = 1.33
RANGE_LIMITS_M = (15.0, 30.0, 45.0)  # range limits of the bands; the paper has the first two
MAX_EPS_M = (0.5, 0.7, 0.9, 1.0)  # maximum eps per band; larger values merge people who walk side by side
MIN_SAMPLES = 3
DENSITY_FACTOR = 0.75  # clustering.density relative to the sensor's density; below 1 so that its clouds are not sparse
NO_INTENSITY_MAX = 1e9  # full scale with which every intensity becomes 0
MIN_RANGE_RATIO = 0.9  # minimum range of Patchwork++, relative to the distance of the nearest ground
PATCHWORK_RANGE_M = 80.0  # default of ground.patchwork.max_range
HINT_REASON = "from --height-hint; no ground in view"


def choose_params(m: SensorMeasurement) -> Choices:
    """Choose the node parameters that depend on the sensor and its mount. Raise InputError if one is out of range."""
    choices = _choose_intensity(m) | _choose_crop(m)
    mount = m.mounting.mount
    if mount is not None:
        choices |= _choose_ground(m, mount)
    elif m.mounting.height_hint is not None:
        choices["ground.sensor_pose.height"] = (m.mounting.height_hint, HINT_REASON)
    max_range = float(np.clip(np.ceil(m.view.max_range), 20.0, 200.0))
    if max_range < PATCHWORK_RANGE_M and m.view.max_range > MIN_OUTDOOR_RANGE_M:
        choices["ground.patchwork.max_range"] = (max_range, "no return is farther")
    if m.pattern.beams is not None and np.isfinite(m.pattern.azimuth_step):
        choices |= _choose_clustering(m)
    try:
        with_values(PipelineParams(), {name: value for name, (value, _) in choices.items()})
    except ValueError as error:
        raise InputError(
            f"{m.source.name}: the measured values are out of range: {error}; "
            "use clouds in metres, from a sensor on a robot or a vehicle"
        ) from None
    return choices | _choose_ahead(m)


def format_value(value: Any) -> str:
    """Return a parameter value as YAML."""
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{float(v)}" for v in value) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _choose_intensity(m: SensorMeasurement) -> Choices:
    scan = m.source.scans[0]
    if m.intensity is not None:
        reason = f"intensities are up to {m.intensity.maximum:.4g}" + ("" if m.intensity.is_certain else "; a guess")
        return {"input.intensity_max": (m.intensity.full_scale, reason)}
    if scan.intensity is None or not scan.intensity.any():
        return {}
    reason = "intensities are constant and carry no information: set to 0, as in sensor.yaml"
    return {"input.intensity_max": (NO_INTENSITY_MAX, reason)}


def _choose_crop(m: SensorMeasurement) -> Choices:
    coverage = m.view.coverage
    if not coverage.can_crop:
        return {}
    reason = (
        f"around the returns of the robot's body, {100 * coverage.body_fraction:.1f} % of all; "
        f"{100 * coverage.foreign_fraction:.0f} % of the points in the box are not on the body" + _describe_base_box(m)
    )
    return {"crop.body": (tuple(round(float(v), 2) for v in coverage.box), reason)}


def _describe_base_box(m: SensorMeasurement) -> str:
    """Describe the body's box in base_frame, which encloses the box in the sensor's frame."""
    pose, frame = m.mounting.recorded.footprint, f"in '{FOOTPRINT}' by TF"
    if pose is None and m.mounting.mount is not None:
        pose = m.mounting.mount.pose
        frame = "in a frame below the sensor with the same heading (otherwise add the sensor's position)"
    note = "\nIt is in the sensor's frame. Nodes with base_frame expect it in that frame"
    if pose is None:
        return note + "."
    low, high = np.reshape(m.view.coverage.box, (2, 3))
    corners = transform_points(np.array([*itertools.product(*zip(low, high))]), pose)
    box = (*corners.min(axis=0).round(2), *corners.max(axis=0).round(2))
    return f"{note}; {frame}:\nbody: {format_value(box)}"


def _choose_ground(m: SensorMeasurement, mount: Mount) -> Choices:
    choices: Choices = {"ground.sensor_pose.height": (round(mount.height, 3), f"+- {mount.error[0]:.3f} m")}
    for name, value, error in (("roll", mount.roll, mount.error[1]), ("pitch", mount.pitch, mount.error[2])):
        reason = f"{np.degrees(value):.2f} +- {np.degrees(error):.2f} degrees"
        choices[f"ground.sensor_pose.{name}"] = (round(value, 4), reason)
    distances = []
    for scan, plane in zip(m.source.scans, mount.planes):
        if plane is not None:
            ground = transform_points(scan.xyz[plane.inliers], mount.pose)
            distances.append(np.percentile(np.hypot(*ground[:, :2].T), 1))
    nearest_distance = float(np.median(distances))
    reason = f"the nearest ground is {nearest_distance:.1f} m away"
    return choices | {"ground.patchwork.min_range": (round(MIN_RANGE_RATIO * nearest_distance, 1), reason)}


def _choose_ahead(m: SensorMeasurement) -> Choices:
    heading, recorded = m.mounting.heading, m.mounting.recorded
    if heading is None or not heading.is_off_axis or heading.may_be_reversed:
        return {}
    tf_agrees = abs(wrap_degrees(recorded.heading - heading.degrees)) <= MAX_OFF_AXIS
    reason = (
        "forward direction of the detectors, not the clouds' x axis: "
        f"{heading.degrees:.0f} +- {heading.error:.0f} degrees by the clouds"
        + (f", {recorded.heading:.0f} by TF" if np.isfinite(recorded.heading) else "")
    )
    return {"input.ahead": (float(round(recorded.heading if tf_agrees else heading.degrees)), reason)}


def _choose_clustering(m: SensorMeasurement) -> Choices:
    elevation_step, azimuth_step = m.elevation_step, m.pattern.azimuth_step
    default = flatten(PipelineParams())
    default_area = default["resolution.elevation_step"] * default["resolution.azimuth_step"]
    relative_density = default_area / (elevation_step * azimuth_step)
    beam_spacing = [np.radians(elevation_step) * limit for limit in (*RANGE_LIMITS_M, RANGE_LIMITS_M[-1] * 1.3)]
    min_eps = (*default["clustering.dbscan.eps"], 0.7)
    eps = tuple(
        round(float(min(max(EPS_RATIO * spacing, low), high)), 2)
        for spacing, low, high in zip(beam_spacing, min_eps, MAX_EPS_M)
    )
    default_samples = default["clustering.dbscan.min_samples"]
    min_samples = int(np.clip(round(default_samples * relative_density), MIN_SAMPLES, default_samples))
    density = 1.0 / (elevation_step * azimuth_step)
    adapted_params = adapt_to_density(ClusteringParams(density=FULL_DENSITY), density).euclidean
    return {
        "clustering.dbscan.range_limits": (RANGE_LIMITS_M, "a fourth band, because the resolution is high enough"),
        "clustering.dbscan.eps": (
            eps,
            f"{EPS_RATIO} times the beam spacing at the end of each band, at least the paper's, "
            "and small enough not to merge people",
        ),
        "clustering.dbscan.join_bands": (True, "no cluster is cut at the end of a band"),
        "clustering.dbscan.min_samples": (
            min_samples,
            f"10 for the HDL-64E; the sensor has {relative_density:.2f} times as many points on a surface",
        ),
        "clustering.density": (
            round(min(FULL_DENSITY, DENSITY_FACTOR * density), 2),
            f"the values here are for {density:.1f} points per square degree; "
            "in sparser clouds they adapt to the density",
        ),
        "clustering.euclidean.min_size": (min_samples, "as for dbscan"),
        "clustering.euclidean.radius": (round(adapted_params.radius, 2), "adapted to the density"),
        "clustering.euclidean.beta": (round(adapted_params.beta, 2), "adapted to the density"),
        "resolution.elevation_step": (round(elevation_step, 3), "median spacing of the beams that hit people"),
        "resolution.azimuth_step": (round(azimuth_step, 3), "between points of a beam"),
    }
