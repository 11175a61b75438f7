"""Parameters of the nodes chosen for a measured sensor, each with its reason."""

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
from lidar_perception.sensor_setup.measurement.recorded_poses import FOOTPRINT
from lidar_perception.types import InputError

Reasons = dict[str, tuple[Any, str]]  # parameter name -> (value, reason)

# The paper's neighbourhoods (0.15, 0.30, 0.50 m up to 15, 30, 45 m) are this many times the
# beam spacing of the HDL-64E at the end of each band.
EPS_BEAMS = 1.33
RANGE_LIMITS_M = (15.0, 30.0, 45.0)  # range limits of the bands; the paper has the first two
MAX_EPS_M = (0.5, 0.7, 0.9, 1.0)  # maximum eps per band; a larger one merges people who walk side by side
MIN_SAMPLES = 3
DENSITY_SHARE = 0.75  # fraction of the sensor's density, low enough that none of its clouds counts as thin
NO_INTENSITY_MAX = 1e9  # full scale at which every intensity counts as 0
MIN_RANGE_SHARE = 0.9  # fraction of the distance to the nearest ground at which Patchwork++ starts
PATCHWORK_RANGE_M = 80.0  # default of ground.patchwork.max_range
HINT_REASON = "from --height-hint; no ground in view"


def choose_params(m: SensorMeasurement) -> Reasons:
    """Choose parameters of the nodes for the sensor and its mount, except defaults.

    Raises:
        InputError: A value is out of the range of its parameter.
    """
    chosen: Reasons = {}
    scans = m.source.scans
    if m.intensity is not None:
        chosen["input.intensity_max"] = (
            m.intensity.full,
            f"intensities are up to {m.intensity.greatest:.4g}" + ("" if m.intensity.sure else "; a guess"),
        )
    elif scans[0].intensity is not None and scans[0].intensity.any():
        chosen["input.intensity_max"] = (
            NO_INTENSITY_MAX,
            "intensities are constant and carry no information: read as 0, as in sensor.yaml",
        )
    coverage, mount = m.view.coverage, m.mounting.mount
    if coverage.can_crop:
        chosen["crop.body"] = (
            tuple(round(float(v), 2) for v in coverage.box),
            f"around the robot's own returns, {100 * coverage.body_share:.1f} % of all; "
            f"{100 * coverage.foreign_share:.0f} % of the points in it are not its own" + _describe_base_box(m),
        )
    if mount is not None:
        chosen["ground.sensor_pose.height"] = (round(mount.height, 3), f"+- {mount.error[0]:.3f} m")
        for name, value, error in (("roll", mount.roll, mount.error[1]), ("pitch", mount.pitch, mount.error[2])):
            chosen[f"ground.sensor_pose.{name}"] = (
                round(value, 4),
                f"{np.degrees(value):.2f} +- {np.degrees(error):.2f} degrees",
            )
        nearest = float(
            np.median(
                [
                    np.percentile(np.hypot(*transform_points(s.xyz[p.on], mount.pose)[:, :2].T), 1)
                    for s, p in zip(scans, mount.planes)
                    if p is not None
                ]
            )
        )
        chosen["ground.patchwork.min_range"] = (
            round(MIN_RANGE_SHARE * nearest, 1),
            f"the nearest ground is {nearest:.1f} m away",
        )
    elif m.mounting.height_hint is not None:
        chosen["ground.sensor_pose.height"] = (m.mounting.height_hint, HINT_REASON)
    reach = float(np.clip(np.ceil(m.view.max_range), 20.0, 200.0))
    if reach < PATCHWORK_RANGE_M and m.view.max_range > MIN_OUTDOOR_RANGE_M:
        chosen["ground.patchwork.max_range"] = (reach, "nothing is farther")
    if m.pattern.beams is not None and np.isfinite(m.pattern.azimuth_step):
        chosen |= _choose_clustering(m)
    try:
        with_values(PipelineParams(), {name: value for name, (value, _) in chosen.items()})
    except ValueError as error:
        raise InputError(
            f"{m.source.name}: the measured values are out of range: {error}; give "
            "clouds, in metres, of a sensor on a robot or a vehicle"
        ) from None
    heading, recorded = m.mounting.heading, m.mounting.recorded
    if heading is not None and heading.is_off_axis and not heading.may_be_reversed:
        agrees = abs(wrap_degrees(recorded.heading - heading.degrees)) <= MAX_OFF_AXIS
        chosen["input.ahead"] = (
            float(round(recorded.heading if agrees else heading.degrees)),
            "direction in which detectors look, not the clouds' x axis: "
            f"{heading.degrees:.0f} +- {heading.error:.0f} degrees by the clouds"
            + (f", {recorded.heading:.0f} by TF" if np.isfinite(recorded.heading) else ""),
        )
    return chosen


def format_value(value: Any) -> str:
    """Return a parameter value as YAML."""
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{float(v)}" for v in value) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)


def _describe_base_box(m: SensorMeasurement) -> str:
    """Return lines with the body's box in base_frame, in which nodes read it if they have one.

    It contains the corners of the box in the sensor's frame.
    """
    pose, frame = m.mounting.recorded.footprint, f"in '{FOOTPRINT}' by TF"
    if pose is None and m.mounting.mount is not None:
        pose = m.mounting.mount.pose
        frame = "in a frame below the sensor with the same heading (else add the sensor's position)"
    if pose is None:
        return "\nIt is in the sensor's frame. Nodes with base_frame read it in that frame."
    low, high = np.reshape(m.view.coverage.box, (2, 3))
    corners = transform_points(np.array([*itertools.product(*zip(low, high))]), pose)
    box = (*corners.min(axis=0).round(2), *corners.max(axis=0).round(2))
    return (
        "\nIt is in the sensor's frame. Nodes with base_frame read it in that frame; "
        f"{frame}:\nbody: {format_value(box)}"
    )


def _choose_clustering(m: SensorMeasurement) -> Reasons:
    elevation_step, azimuth_step = m.elevation_step, m.pattern.azimuth_step
    default = flatten(PipelineParams())
    relative_density = (default["resolution.elevation_step"] * default["resolution.azimuth_step"]) / (
        elevation_step * azimuth_step
    )
    gaps = [np.radians(elevation_step) * limit for limit in (*RANGE_LIMITS_M, RANGE_LIMITS_M[-1] * 1.3)]
    paper = (*default["clustering.dbscan.eps"], 0.7)
    eps = tuple(round(float(min(max(EPS_BEAMS * gap, low), high)), 2) for gap, low, high in zip(gaps, paper, MAX_EPS_M))
    samples = int(
        np.clip(
            round(default["clustering.dbscan.min_samples"] * relative_density),
            MIN_SAMPLES,
            default["clustering.dbscan.min_samples"],
        )
    )
    density = 1.0 / (elevation_step * azimuth_step)
    adapted = adapt_to_density(ClusteringParams(density=FULL_DENSITY), density).euclidean
    return {
        "clustering.dbscan.range_limits": (RANGE_LIMITS_M, "a fourth band, as the resolution allows"),
        "clustering.dbscan.eps": (
            eps,
            f"{EPS_BEAMS} times the distance of the beams at the end "
            "of each band, at least the paper's, and small enough not to "
            "join people",
        ),
        "clustering.dbscan.join_bands": (True, "no cluster is cut at the end of a band"),
        "clustering.dbscan.min_samples": (
            samples,
            f"10 for the HDL-64E; the sensor has {relative_density:.2f} times as many points on a surface",
        ),
        "clustering.density": (
            round(min(FULL_DENSITY, DENSITY_SHARE * density), 2),
            f"the values here are for {density:.1f} points per square degree; "
            "in thinner clouds they adapt to the density",
        ),
        "clustering.euclidean.min_size": (samples, "as for dbscan"),
        "clustering.euclidean.radius": (round(adapted.radius, 2), "adapted to the density"),
        "clustering.euclidean.beta": (round(adapted.beta, 2), "adapted to the density"),
        "resolution.elevation_step": (round(elevation_step, 3), "between beams where people are, the median"),
        "resolution.azimuth_step": (round(azimuth_step, 3), "between points of a beam"),
    }
