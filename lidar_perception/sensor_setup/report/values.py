"""Table of the measured values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.intensity import INTENSITY_FIELDS
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.sensor_setup.measurement.scans import RING_FIELDS
from lidar_perception.sensor_setup.report.warnings import MAX_SLOPE_SPREAD, MIN_TURN_S, check_recorded_poses
from lidar_perception.wire.point_times import NAMES as TIMES

HIGH, FAIR, LOW = "high", "fair", "low"  # levels of confidence


class MeasuredValue(NamedTuple):
    """A measured value: its name, the value with its unit, and HIGH, FAIR or LOW confidence."""

    name: str
    value: str
    confidence: str


def list_values(m: SensorMeasurement) -> list[MeasuredValue]:
    """Return every measured value."""
    return [
        *_describe_beams(m),
        *_describe_view(m),
        *_describe_columns(m),
        *_describe_mount(m),
        *_describe_heading(m),
        *_describe_timing(m),
    ]


def _describe_beams(m: SensorMeasurement) -> list[MeasuredValue]:
    p = m.pattern
    if p.beams is None:
        low, high = np.percentile(np.concatenate([s.elevation for s in m.source.scans]), [0.2, 99.8])
        return [MeasuredValue("beams", f"none, {low:.1f} to {high:.1f} deg", FAIR)]
    up, max_error = p.beams.elevations, float(p.beams.error.max())
    error = max(max_error, float(np.median(p.beams.spread)))
    return [
        MeasuredValue(
            "beams",
            f"{len(up)}, {up[-1]:.2f} to {up[0]:.2f} deg, error up to {max_error:.3f} deg, by {p.beams.method}",
            LOW if error > 0.3 else FAIR if error > 0.05 or p.is_moved else HIGH,
        ),
        MeasuredValue("model", p.model or "none of config/sensors", HIGH if p.model else FAIR),
        MeasuredValue("azimuth step", f"{p.azimuth_step:.4f} deg, {360 / p.azimuth_step:.0f} in a turn", HIGH),
        MeasuredValue("range noise", f"{100 * p.range_noise:.1f} cm", LOW if np.isnan(p.range_noise) else FAIR),
    ]


def _describe_view(m: SensorMeasurement) -> list[MeasuredValue]:
    c, few = m.view.coverage, m.source.has_few_scans
    start, end = c.view
    hidden = sum((b - a) % 360 or 360 for _, a, b in c.blocked)
    is_body_certain = c.still is False and not few and (c.can_crop or not len(c.box))
    return [
        MeasuredValue(
            "field of view",
            "360 deg"
            if (start, end) == (0.0, 360.0)
            else f"{(end - start) % 360:.0f} deg, from {start:.0f} to {end:.0f}",
            LOW if few else HIGH,
        ),
        MeasuredValue("blind sectors", f"{len(c.blocked)}, {hidden:.0f} deg together", LOW if few else FAIR),
        MeasuredValue(
            "body",
            "none found"
            if not len(c.box)
            else f"{100 * c.body_share:.1f} % of the points, from {_format_point(c.box[:3])} "
            f"to {_format_point(c.box[3:])} m",
            FAIR if is_body_certain else LOW,
        ),
        MeasuredValue(
            "range",
            f"{m.view.min_range:.2f} to {m.view.max_range:.1f} m",
            FAIR if m.view.max_range > MIN_OUTDOOR_RANGE_M else LOW,
        ),
    ]


def _describe_columns(m: SensorMeasurement) -> list[MeasuredValue]:
    scan, i = m.source.scans[0], m.intensity
    names = {
        kind: next((name for name in known if name in scan.columns), "")
        for kind, known in (("intensity", INTENSITY_FIELDS), ("ring", RING_FIELDS), ("time", TIMES))
    }
    values = [
        MeasuredValue(
            "columns", ", ".join(f"{kind}: {name}" if name else f"no {kind}" for kind, name in names.items()), HIGH
        )
    ]
    if i is not None:
        values.append(
            MeasuredValue(
                "intensity",
                f"0 to {i.full:g}{' in whole numbers' if i.whole else ''}, 0 for {100 * i.zeros:.1f} % of the points",
                HIGH if i.sure else LOW,
            )
        )
    if scan.seconds is not None:
        low, high = float(np.nanmin(scan.seconds)), float(np.nanmax(scan.seconds))
        values.append(
            MeasuredValue(
                "time of points",
                f"{1000 * low:.1f} to {1000 * high:.1f} ms after header.stamp",
                HIGH if high - low > MIN_TURN_S else LOW,
            )
        )
    return values


def _describe_mount(m: SensorMeasurement) -> list[MeasuredValue]:
    mount = m.mounting.mount
    if mount is None:
        return [MeasuredValue("height", "unknown: no ground in view", LOW)]
    error, spread = np.degrees(mount.error), np.degrees(mount.spread)
    # In a single place, the slope of the ground is part of the measured tilt.
    confidence = (
        HIGH
        if (
            not m.source.has_few_scans
            and spread[1:].max() < MAX_SLOPE_SPREAD
            and (not m.view.coverage.still and not m.pattern.is_moved)
        )
        else FAIR
    )
    return [
        MeasuredValue("height", f"{mount.height:.3f} +- {mount.error[0]:.3f} m", confidence),
        MeasuredValue("roll", f"{np.degrees(mount.roll):.2f} +- {error[1]:.2f} deg", confidence),
        MeasuredValue("pitch", f"{np.degrees(mount.pitch):.2f} +- {error[2]:.2f} deg", confidence),
    ]


def _describe_heading(m: SensorMeasurement) -> list[MeasuredValue]:
    heading, recorded = m.mounting.heading, m.mounting.recorded
    values = [
        MeasuredValue("ahead", "unknown", LOW)
        if heading is None or heading.problem
        else MeasuredValue(
            "ahead", f"{heading.degrees:z.0f} +- {heading.error:.0f} deg from x", LOW if heading.is_off_axis else FAIR
        )
    ]
    if recorded.mount is not None:
        roll, pitch = recorded.roll_pitch
        values.append(
            MeasuredValue(
                "mount by TF",
                f"in '{recorded.base}' at {_format_point(recorded.mount[:3, 3])} m, "
                f"roll {roll:z.2f}, pitch {pitch:z.2f}, ahead {recorded.heading:z.0f} deg from x",
                LOW if check_recorded_poses(m) else HIGH,
            )
        )
    return values


def _describe_timing(m: SensorMeasurement) -> list[MeasuredValue]:
    t = m.timing
    values = [
        MeasuredValue(
            "rate",
            "unknown" if np.isnan(t.rate) else f"{t.rate:.2f} turns per second, from {t.source}",
            {"stamps": HIGH, "nothing": LOW}.get(t.source, FAIR),
        )
    ]
    if t.source == "stamps":
        values.append(MeasuredValue("losses", f"{t.missing} of {m.source.total + t.missing} clouds", HIGH))
    values.append(
        MeasuredValue("frame", ", ".join(m.source.frame_ids) or "none", HIGH if len(m.source.frame_ids) == 1 else LOW)
    )
    return values


def _format_point(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in values) + ")"
