"""Table of the measured values, with method and confidence."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lidar_perception.intensity import INTENSITY_FIELDS
from lidar_perception.sensor_setup.measurement.coverage import MIN_BODY_SCANS, NEAR_BODY_M
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.sensor_setup.measurement.recorded_poses import FOOTPRINT
from lidar_perception.sensor_setup.measurement.scans import RING_FIELDS
from lidar_perception.sensor_setup.report.warnings import (
    MAX_SLOPE_SPREAD,
    MIN_TURN_S,
    check_recorded_poses,
)
from lidar_perception.wire.point_times import NAMES as TIMES

HIGH, FAIR, LOW = "high", "fair", "low"  # confidence
BEAM_METHODS = {"ring": "by the ring column", "order": "by the order of the points",
                "elevation": "by peaks of the elevations"}


class MeasuredValue(NamedTuple):
    """A measured value: its name, the value, how it was measured, and HIGH, FAIR or LOW."""

    name: str
    value: str
    method: str
    confidence: str


def list_values(m: SensorMeasurement) -> list[MeasuredValue]:
    """Return every measured value."""
    return [*_describe_beams(m), *_describe_view(m), *_describe_columns(m), *_describe_mount(m),
            _describe_heading(m), *_describe_recorded(m), *_describe_timing(m)]


def _count_scans(m: SensorMeasurement) -> str:
    count = len(m.source.scans)
    return f"{count} scan{'s' * (count != 1)}"


def _describe_beams(m: SensorMeasurement) -> list[MeasuredValue]:
    p = m.pattern
    if p.beams is None:
        low, high = np.percentile(np.concatenate([s.elevation for s in m.source.scans]),
                                  [0.2, 99.8])
        return [MeasuredValue("beams", f"none, {low:.1f} to {high:.1f} deg",
                              "points are on no beams", FAIR)]
    up, spread = p.beams.elevations, np.median(p.beams.spread)
    error = max(float(p.beams.error.max()), float(spread))
    return [
        MeasuredValue("beams", f"{len(up)}, {up[-1]:.2f} to {up[0]:.2f} deg",
                      f"{BEAM_METHODS[p.beams.method]}, {_count_scans(m)}; error up to "
                      f"{p.beams.error.max():.3f} deg, points of a beam within {spread:.3f} deg",
                      LOW if error > 0.3 else FAIR if error > 0.05 or p.is_moved else HIGH),
        MeasuredValue("model", p.model or "none of config/sensors",
                      f"beams within {p.model_error:.3f} deg of the model's" if p.model else
                      "no model has such beams", HIGH if p.model else FAIR),
        MeasuredValue("azimuth step",
                      f"{p.azimuth_step:.4f} deg, {360 / p.azimuth_step:.0f} in a turn",
                      "mean distance of neighbours in a beam", HIGH),
        MeasuredValue("range noise", f"{100 * p.range_noise:.1f} cm", "about smooth surfaces, "
                      f"{p.noise_pieces} pieces of 9 returns of a beam",
                      FAIR if p.noise_pieces > 500 else LOW)]


def _describe_view(m: SensorMeasurement) -> list[MeasuredValue]:
    c, few = m.view.coverage, m.source.has_few_scans
    start, end = c.view
    hidden = sum((b - a) % 360 or 360 for _, a, b in c.blocked)
    limits = (f", within {NEAR_BODY_M:g} m: farther ones include walls" if c.has_walls else
              "" if c.still is False else
              f", within {NEAR_BODY_M:g} m: the robot may have stood still")
    return [
        MeasuredValue("field of view", "360 deg" if (start, end) == (0.0, 360.0) else
                      f"{(end - start) % 360:.0f} deg, from {start:.0f} to {end:.0f}",
                      f"azimuths with returns, {_count_scans(m)}", LOW if few else HIGH),
        MeasuredValue("blind sectors", f"{len(c.blocked)}, {hidden:.0f} deg together",
                      "where lower beams never have a return", LOW if few else FAIR),
        MeasuredValue("body", "none seen" if not len(c.box) else
                      f"{100 * c.body_share:.1f} % of the points, from {_format_point(c.box[:3])} "
                      f"to {_format_point(c.box[3:])} m",
                      f"returns in {100 * MIN_BODY_SCANS:.0f} % of the scans at the same range"
                      + limits,
                      FAIR if c.still is False and not few and (c.can_crop or not len(c.box))
                      else LOW),
        MeasuredValue("range", f"{m.view.min_range:.2f} to {m.view.max_range:.1f} m",
                      "of returns that are not of the body",
                      FAIR if m.view.max_range > MIN_OUTDOOR_RANGE_M else LOW)]


def _describe_columns(m: SensorMeasurement) -> list[MeasuredValue]:
    scan = m.source.scans[0]
    named = {"intensity": next((n for n in INTENSITY_FIELDS if n in scan.columns), ""),
             "ring": next((n for n in RING_FIELDS if n in scan.columns), ""),
             "time": next((n for n in TIMES if n in scan.columns), "")}
    unused = [c for c in scan.columns if c not in ("x", "y", "z", *named.values())]
    values = [MeasuredValue("columns", ", ".join(scan.columns), "; ".join(
        f"{kind}: {name}" if name else f"no {kind}" for kind, name in named.items())
        + (f"; not used: {', '.join(unused)}" if unused else ""), HIGH)]
    i = m.intensity
    if i is not None:
        kind = " in whole numbers" if i.whole else ""
        values.append(MeasuredValue(
            "intensity", f"0 to {i.full:g}{kind}",
            f"up to {i.greatest:.4g}; 0 for {100 * i.zeros:.1f} %, median {i.quantiles[50]:.3g}, "
            f"{100 * i.bright:.2f} % as bright as retroreflectors", HIGH if i.sure else LOW))
    if scan.seconds is not None:
        low, high = float(np.nanmin(scan.seconds)), float(np.nanmax(scan.seconds))
        values.append(MeasuredValue(
            "time of points", f"{1000 * low:.1f} to {1000 * high:.1f} ms",
            f"column '{named['time']}', after header.stamp",
            HIGH if high - low > MIN_TURN_S else LOW))
    return values


def _describe_mount(m: SensorMeasurement) -> list[MeasuredValue]:
    mount = m.mounting.mount
    if mount is None:
        return [MeasuredValue("height", "unknown", "no ground in view", LOW)]
    found = sum(plane is not None for plane in mount.planes)
    method = f"plane through the ground around, {found} of {len(m.source.scans)} scans"
    error, spread = np.degrees(mount.error), np.degrees(mount.spread)
    # In one place the slope of the ground counts as tilt.
    confidence = HIGH if (not m.source.has_few_scans and spread[1:].max() < MAX_SLOPE_SPREAD and (
        not m.view.coverage.still and not m.pattern.is_moved)) else FAIR
    return [MeasuredValue("height", f"{mount.height:.3f} +- {mount.error[0]:.3f} m",
                          f"{method}; from scan to scan {mount.spread[0]:.3f} m", confidence),
            MeasuredValue("roll", f"{np.degrees(mount.roll):.2f} +- {error[1]:.2f} deg",
                          f"{method}; from scan to scan {spread[1]:.2f} deg", confidence),
            MeasuredValue("pitch", f"{np.degrees(mount.pitch):.2f} +- {error[2]:.2f} deg",
                          f"{method}; from scan to scan {spread[2]:.2f} deg", confidence)]


def _describe_heading(m: SensorMeasurement) -> MeasuredValue:
    h, recorded = m.mounting.heading, m.mounting.recorded
    if h is None or h.problem:
        return MeasuredValue("ahead", "unknown", h.problem if h else "no ground in view", LOW)
    clouds = f"the shift of the surroundings in {h.pairs} pairs of clouds"
    method = (f"direction of x of '{recorded.base}', by its motion and {clouds}" if h.from_base
              else "direction in which the robot drives, by "
              + ("the sensor's odometry" if recorded.poses and not recorded.base else clouds))
    return MeasuredValue("ahead", f"{h.degrees:z.0f} +- {h.error:.0f} deg from x", method,
                         LOW if h.is_off_axis else FAIR)


def _describe_recorded(m: SensorMeasurement) -> list[MeasuredValue]:
    recorded = m.mounting.recorded
    if recorded.mount is None:
        return []
    roll, pitch = recorded.roll_pitch
    above = "" if np.isnan(recorded.height) else f"; {recorded.height:.3f} m above '{FOOTPRINT}'"
    return [MeasuredValue(
        "mount by TF",
        f"roll {roll:z.2f}, pitch {pitch:z.2f}, ahead {recorded.heading:z.0f} deg from x",
        f"transforms of the bag, in '{recorded.base}', at "
        f"{_format_point(recorded.mount[:3, 3])} m{above}",
        LOW if check_recorded_poses(m) else HIGH)]


def _describe_timing(m: SensorMeasurement) -> list[MeasuredValue]:
    t = m.timing
    values = [MeasuredValue("rate", "unknown" if np.isnan(t.rate) else
                            f"{t.rate:.2f} turns per second", f"from {t.source}",
                            {"stamps": HIGH, "nothing": LOW}.get(t.source, FAIR))]
    if t.direction and m.pattern.beams is not None and m.pattern.beams.method != "order":
        values.append(MeasuredValue("rotation", t.direction, "by the points' " + (
            "times" if m.source.scans[0].seconds is not None else "order"), FAIR))
    if t.source == "stamps":
        values.append(MeasuredValue(
            "losses", f"{t.missing} clouds in {t.gaps} gaps",
            f"of the stamps of {m.source.total} clouds; they jitter by {1000 * t.jitter:.1f} ms",
            HIGH))
    values.append(MeasuredValue("frame", ", ".join(m.source.frame_ids) or "none",
                                "header.frame_id", HIGH if len(m.source.frame_ids) == 1 else LOW))
    return values


def _format_point(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.2f}" for v in values) + ")"
