"""Table of measured values."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from typing import NamedTuple

import numpy as np

from lidar_perception.intensity import INTENSITY_FIELDS
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.sensor_setup.measurement.scans import RING_FIELDS
from lidar_perception.sensor_setup.report.warnings import MAX_SLOPE_SPREAD, MIN_REVOLUTION_S, check_recorded_poses
from lidar_perception.wire.point_times import NAMES as TIME_FIELDS

HIGH, FAIR, LOW = "high", "fair", "low"  # levels of confidence

Rows = Iterator[tuple[str, str, str]]  # fields of MeasuredValue


class MeasuredValue(NamedTuple):
    """A measured value: its name, the value with its unit, and HIGH, FAIR or LOW confidence."""

    name: str
    value: str
    confidence: str


def list_values(m: SensorMeasurement) -> list[MeasuredValue]:
    """List all measured values."""
    rows = chain(
        _describe_beams(m),
        _describe_view(m),
        _describe_columns(m),
        _describe_mount(m),
        _describe_heading(m),
        _describe_timing(m),
    )
    return [MeasuredValue(*row) for row in rows]


def _describe_beams(m: SensorMeasurement) -> Rows:
    p = m.pattern
    if p.beams is None:
        low, high = np.percentile(np.concatenate([s.elevation for s in m.source.scans]), [0.2, 99.8])
        yield "beams", f"none, {low:.1f} to {high:.1f} deg", FAIR
        return
    elevations, max_error = p.beams.elevations, float(p.beams.error.max())
    error = max(max_error, float(np.median(p.beams.spread)))
    yield (
        "beams",
        f"{len(elevations)}, {elevations[-1]:.2f} to {elevations[0]:.2f} deg, error up to {max_error:.3f} deg, "
        f"by {p.beams.method}",
        LOW if error > 0.3 else FAIR if error > 0.05 or p.is_moved else HIGH,
    )
    yield "model", p.model or "none of config/sensors", HIGH if p.model else FAIR
    yield "azimuth step", f"{p.azimuth_step:.4f} deg, {360 / p.azimuth_step:.0f} per revolution", HIGH
    yield "range noise", f"{100 * p.range_noise:.1f} cm", LOW if np.isnan(p.range_noise) else FAIR


def _describe_view(m: SensorMeasurement) -> Rows:
    c, has_few_scans = m.view.coverage, m.source.has_few_scans
    start, end = c.view
    is_full_circle = (start, end) == (0.0, 360.0)
    field_of_view = "360 deg" if is_full_circle else f"{(end - start) % 360:.0f} deg, from {start:.0f} to {end:.0f}"
    yield "field of view", field_of_view, LOW if has_few_scans else HIGH
    blind_angle = sum((b - a) % 360 or 360 for _, a, b in c.blocked)
    yield "blind sectors", f"{len(c.blocked)}, {blind_angle:.0f} deg in total", LOW if has_few_scans else FAIR
    body = "none found"
    if len(c.box):
        low, high = _format_point(c.box[:3]), _format_point(c.box[3:])
        body = f"{100 * c.body_fraction:.1f} % of the points, from {low} to {high} m"
    is_body_certain = c.stationary is False and not has_few_scans and (c.can_crop or not len(c.box))
    yield "body", body, FAIR if is_body_certain else LOW
    is_outdoors = m.view.max_range > MIN_OUTDOOR_RANGE_M
    yield "range", f"{m.view.min_range:.2f} to {m.view.max_range:.1f} m", FAIR if is_outdoors else LOW


def _describe_columns(m: SensorMeasurement) -> Rows:
    scan, intensity = m.source.scans[0], m.intensity
    columns = []
    for quantity, names in (("intensity", INTENSITY_FIELDS), ("ring", RING_FIELDS), ("time", TIME_FIELDS)):
        column = next((name for name in names if name in scan.columns), "")
        columns.append(f"{quantity}: {column}" if column else f"no {quantity}")
    yield "columns", ", ".join(columns), HIGH
    if intensity is not None:
        yield (
            "intensity",
            f"0 to {intensity.full_scale:g}{' in integers' if intensity.is_integer else ''}, "
            f"0 for {100 * intensity.zero_fraction:.1f} % of the points",
            HIGH if intensity.is_certain else LOW,
        )
    if scan.seconds is not None:
        low, high = float(np.nanmin(scan.seconds)), float(np.nanmax(scan.seconds))
        span = f"{1000 * low:.1f} to {1000 * high:.1f} ms after header.stamp"
        yield "time of points", span, HIGH if high - low > MIN_REVOLUTION_S else LOW


def _describe_mount(m: SensorMeasurement) -> Rows:
    mount = m.mounting.mount
    if mount is None:
        yield "height", "unknown: no ground in view", LOW
        return
    error, spread = np.degrees(mount.error), np.degrees(mount.spread)
    # In a single place, a slope of the ground cannot be distinguished from a tilt of the sensor.
    has_moved = not m.source.has_few_scans and not m.view.coverage.stationary
    is_certain = has_moved and spread[1:].max() < MAX_SLOPE_SPREAD and not m.pattern.is_moved
    confidence = HIGH if is_certain else FAIR
    yield "height", f"{mount.height:.3f} +- {mount.error[0]:.3f} m", confidence
    yield "roll", f"{np.degrees(mount.roll):.2f} +- {error[1]:.2f} deg", confidence
    yield "pitch", f"{np.degrees(mount.pitch):.2f} +- {error[2]:.2f} deg", confidence


def _describe_heading(m: SensorMeasurement) -> Rows:
    heading, recorded = m.mounting.heading, m.mounting.recorded
    if heading is None or heading.problem:
        yield "ahead", "unknown", LOW
    else:
        direction = f"{heading.degrees:z.0f} +- {heading.error:.0f} deg from x"
        yield "ahead", direction, LOW if heading.is_off_axis else FAIR
    if recorded.mount is not None:
        roll, pitch = recorded.roll_pitch
        yield (
            "mount by TF",
            f"in '{recorded.base}' at {_format_point(recorded.mount[:3, 3])} m, "
            f"roll {roll:z.2f}, pitch {pitch:z.2f}, ahead {recorded.heading:z.0f} deg from x",
            LOW if any(check_recorded_poses(m)) else HIGH,
        )


def _describe_timing(m: SensorMeasurement) -> Rows:
    t, frame_ids = m.timing, m.source.frame_ids
    rate = "unknown" if np.isnan(t.rate) else f"{t.rate:.2f} revolutions per second, from {t.source}"
    yield "rate", rate, {"stamps": HIGH, "nothing": LOW}.get(t.source, FAIR)
    if t.source == "stamps":
        yield "losses", f"{t.missing_count} of {m.source.total + t.missing_count} clouds", HIGH
    yield "frame", ", ".join(frame_ids) or "none", HIGH if len(frame_ids) == 1 else LOW


def _format_point(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in values) + ")"
