"""The measured sensor as a sensor that can be simulated."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lidar_perception.sensor_setup.measurement.beams import Beams
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.simulation.sensor import Sensor, find_sensor

DEFAULT_STEP = 0.2  # default azimuth step in degrees


def make_sensor(m: SensorMeasurement) -> Sensor:
    """Return the measured sensor, turned over if it is mounted upside down.

    Properties that clouds do not show, such as the divergence of the beams, are those of the model
    with the same beams, or the defaults. A sensor without beams becomes a grid of the same view
    whose beams wander, with as many points in a turn.
    """
    sensor = _make_in_own_frame(m)
    mount = m.mounting.mount
    return sensor if mount is None or not mount.upside_down else _turn_upside_down(sensor)


def _turn_upside_down(sensor: Sensor) -> Sensor:
    """Turn a sensor, whose blocked sectors are of all beams, about its x axis by half a turn."""
    return replace(
        sensor,
        elevations=tuple(sensor.wander - up for up in reversed(sensor.elevations)),
        lifts=tuple(-lift for lift in reversed(sensor.lifts)),
        blocked=tuple((first, -end % 360, -start % 360 or 360.0) for first, start, end in sensor.blocked),
    )


def _make_in_own_frame(m: SensorMeasurement) -> Sensor:
    pattern, coverage, mounting = m.pattern, m.view.coverage, m.mounting
    model = find_sensor(pattern.model) if pattern.model else None
    fields: dict[str, Any] = (
        {}
        if model is None
        else {
            name: getattr(model, name)
            for name in (
                "divergence",
                "reach",
                "pulse",
                "min_range",
                "max_range",
                "range_noise",
                "rate",
                "silent",
                "floor",
                "fade",
            )
        }
    )
    if m.intensity is None:
        fields["silent"] = 1.0
    if np.isfinite(pattern.range_noise):
        fields["range_noise"] = round(pattern.range_noise, 4)
    if m.view.max_range > MIN_OUTDOOR_RANGE_M or model is None:
        fields["max_range"] = float(np.ceil(max(m.view.max_range, MIN_OUTDOOR_RANGE_M)))
    fields["rate"] = round(m.timing.rate, 2) if np.isfinite(m.timing.rate) else fields.get("rate", 10.0)
    if mounting.mount is not None:
        fields["height"] = round(mounting.mount.height, 3)
    elif mounting.height_hint is not None:
        fields["height"] = mounting.height_hint
    # The nearest surface may be far away, like the ground, or closer than the data sheet's minimum.
    min_range = fields.get("min_range", Sensor.min_range)
    if m.view.min_range < min_range:
        fields["min_range"] = float(np.floor(100 * m.view.min_range) / 100)
    if pattern.beams is None:
        return _make_grid(m, fields)
    # In a single place the surroundings hide more than the robot does, so only the ends of the view
    # count there. The same holds if lower beams do not point lower.
    has_moved = (
        coverage.still is False
        and not m.source.has_few_scans
        and (mounting.mount is not None and mounting.mount.is_level)
    )
    fields["blocked"] = tuple(b for b in coverage.blocked if has_moved or b[0] == 0)
    up, lifts = _select_beams(pattern.beams, model if pattern.prefers_model else None, fields)
    if lifts.any():
        fields["lifts"] = tuple(lifts.tolist())
    step = pattern.azimuth_step if np.isfinite(pattern.azimuth_step) else DEFAULT_STEP
    return Sensor(tuple(up.tolist()), float(np.radians(step)), **fields)


def _select_beams(beams: Beams, model: Sensor | None, fields: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return elevations in rad and lifts, measured or of a model, and adapt the blocked sectors."""
    elevations = np.radians(np.round(beams.elevations, 4))
    if model is None:
        return elevations, np.round(beams.lifts, 4)
    fields["blocked"] = tuple(
        (first and int(np.abs(np.array(model.elevations) - elevations[first]).argmin()), start, end)
        for first, start, end in fields["blocked"]
    )
    return np.array(model.elevations), np.array(model.lifts)


def _make_grid(m: SensorMeasurement, fields: dict[str, Any]) -> Sensor:
    elevations = np.concatenate([scan.elevation for scan in m.source.scans])
    high, low = np.percentile(elevations, [99.8, 0.2])
    points = np.median([len(scan.xyz) for scan in m.source.scans])
    start, end = m.view.coverage.view
    share = ((end - start) % 360 or 360) / 360
    rows = int(np.clip(np.sqrt(points / share * (high - low) / 360), 4, 128))
    gap = (high - low) / rows
    columns = int(np.clip(points / share / rows, 90, 4000))
    if share < 1:
        fields["blocked"] = ((0, end, start),)
    return Sensor(
        tuple(np.radians(high - gap * np.arange(rows)).tolist()),
        2 * np.pi / columns,
        wander=float(np.radians(gap)),
        **fields,
    )
