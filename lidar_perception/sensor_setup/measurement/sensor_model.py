"""Conversion of a measurement to a simulated sensor."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lidar_perception.sensor_setup.measurement.beams import Beams
from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.simulation.sensor import Sensor, find_sensor

DEFAULT_STEP = 0.2  # azimuth step in degrees if it was not measured
MODEL_FIELDS = (
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


def make_sensor(m: SensorMeasurement) -> Sensor:
    """Make a simulated sensor from a measurement.

    Its z axis points up, even if the real sensor is mounted upside down. Properties that cannot be
    measured from clouds, such as the divergence of the beams, are those of the model with the same
    beams, or defaults. A sensor without beams becomes a grid of wandering beams with the same field
    of view and number of points.
    """
    sensor = _make_in_sensor_frame(m)
    mount = m.mounting.mount
    return sensor if mount is None or not mount.upside_down else _flip_sensor(sensor)


def _flip_sensor(sensor: Sensor) -> Sensor:
    """Rotate a sensor by 180 degrees about its x axis. Its sectors must block all beams."""
    return replace(
        sensor,
        elevations=tuple(sensor.wander - elevation for elevation in reversed(sensor.elevations)),
        lifts=tuple(-lift for lift in reversed(sensor.lifts)),
        blocked=tuple((first, -end % 360, -start % 360 or 360.0) for first, start, end in sensor.blocked),
    )


def _make_in_sensor_frame(m: SensorMeasurement) -> Sensor:
    pattern, coverage, mounting = m.pattern, m.view.coverage, m.mounting
    model = find_sensor(pattern.model) if pattern.model else None
    fields: dict[str, Any] = {} if model is None else {name: getattr(model, name) for name in MODEL_FIELDS}
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
    # The measured minimum is used only if it is smaller: there may have been no surface near the sensor.
    min_range = fields.get("min_range", Sensor.min_range)
    if m.view.min_range < min_range:
        fields["min_range"] = float(np.floor(100 * m.view.min_range) / 100)
    if pattern.beams is None:
        return _make_grid(m, fields)
    # Sectors that block only the lower beams are reliable only if the robot moved and the sensor is level.
    has_moved = coverage.stationary is False and not m.source.has_few_scans
    is_level = mounting.mount is not None and mounting.mount.is_level
    fields["blocked"] = tuple(b for b in coverage.blocked if (has_moved and is_level) or b[0] == 0)
    elevations, lifts = _select_beams(pattern.beams, model if pattern.prefers_model else None, fields)
    if lifts.any():
        fields["lifts"] = tuple(lifts.tolist())
    step = pattern.azimuth_step if np.isfinite(pattern.azimuth_step) else DEFAULT_STEP
    return Sensor(tuple(elevations.tolist()), float(np.radians(step)), **fields)


def _select_beams(beams: Beams, model: Sensor | None, fields: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Return the elevations (rad) and lifts (m) of the model, or measured ones without a model.

    The beam numbers in fields["blocked"] are converted to those of the model.
    """
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
    fraction = ((end - start) % 360 or 360) / 360
    rows = int(np.clip(np.sqrt(points / fraction * (high - low) / 360), 4, 128))
    spacing = (high - low) / rows
    columns = int(np.clip(points / fraction / rows, 90, 4000))
    if fraction < 1:
        fields["blocked"] = ((0, end, start),)
    return Sensor(
        tuple(np.radians(high - spacing * np.arange(rows)).tolist()),
        2 * np.pi / columns,
        wander=float(np.radians(spacing)),
        **fields,
    )
