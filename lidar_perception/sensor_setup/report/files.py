"""Files about a measured sensor: sensor.yaml for simulation, robot.param.yaml for the nodes."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidar_perception.sensor_setup.measurement.measure import MIN_OUTDOOR_RANGE_M, SensorMeasurement
from lidar_perception.sensor_setup.measurement.sensor_model import make_sensor
from lidar_perception.sensor_setup.report.params import HINT_REASON, choose_params, format_value
from lidar_perception.sensor_setup.report.warnings import find_warnings
from lidar_perception.simulation.sensor import Sensor

LINE_WIDTH = 98


def format_sensor(m: SensorMeasurement) -> str:
    """Return the text of sensor.yaml, see simulation.sensor.load_sensor."""
    sensor, default = make_sensor(m), Sensor((0.0,), 0.1)
    comments = _explain_sensor(m, sensor)
    values = {
        "name": m.pattern.model or "measured",
        "height": sensor.height,
        "rate": sensor.rate,
        "azimuth_step": round(float(np.degrees(sensor.azimuth_step)), 6),
        "min_range": sensor.min_range,
        "max_range": sensor.max_range,
        "range_noise": sensor.range_noise,
        "reach": sensor.reach,
        "divergence": round(float(np.degrees(sensor.divergence)), 6),
    }
    values |= {
        name: getattr(sensor, name)
        for name in ("silent", "floor", "pulse", "dropout")
        if getattr(sensor, name) != getattr(default, name)
    }
    if sensor.wander:
        values["wander"] = round(float(np.degrees(sensor.wander)), 4)
    if sensor.fade != default.fade:
        values["fade"] = list(sensor.fade)
    units = "Angles in degrees, lengths in metres; docs/how-to/own-sensor.md describes every field."
    text = _format_header(m, _describe_origin(m), units) + "\n"
    for key, value in values.items():
        text += f"{key}: {_format_scalar(value)}" + (f"  # {comments[key]}" if key in comments else "") + "\n"
    text += _format_list("elevations", np.degrees(sensor.elevations), 4)
    if sensor.lifts:
        text += _format_list("lifts", sensor.lifts, 4)
    if sensor.blocked:
        text += "blocked:  # [first beam, from, to]: sector without returns of this beam and all lower ones\n"
        text += "".join(f"- [{ring}, {a:g}, {b:g}]\n" for ring, a, b in sensor.blocked)
    return text


def format_params(m: SensorMeasurement) -> str:
    """Return the text of robot.param.yaml, with the reason for the value of each parameter."""
    choices = choose_params(m)
    note = "All other parameters keep their defaults. Nodes ignore parameters that they do not have."
    lines = [_format_header(m, f"{_describe_origin(m)} {note}"), "/**:"]
    tree: dict[str, Any] = {}
    for name, (value, reason) in choices.items():
        *path, leaf = name.split(".")
        branch = tree
        for part in path:
            branch = branch.setdefault(part, {})
        branch[leaf] = (value, reason)
    lines += ["  ros__parameters:", *_format_tree(tree, 4)] if choices else ["  ros__parameters: {}"]
    return "\n".join(lines) + "\n"


def _explain_sensor(m: SensorMeasurement, sensor: Sensor) -> dict[str, str]:
    """Return a comment for each value of sensor.yaml."""
    pattern, mounting, view = m.pattern, m.mounting, m.view
    unmeasured_note = "not measured; " + (f"value of {pattern.model}" if pattern.model else "default value")
    height = "not measured: no ground in view" if mounting.height_hint is None else HINT_REASON
    if mounting.mount is not None:
        height = f"+- {mounting.mount.error[0]:.3f}"
    has_min_range = view.min_range < sensor.min_range + 0.01
    return {
        "height": height,
        "rate": f"from {m.timing.source}" if np.isfinite(m.timing.rate) else "not measured",
        "azimuth_step": f"{sensor.columns} firings per revolution",
        "min_range": "nearest return outside the robot's body" if has_min_range else unmeasured_note,
        "max_range": "farthest return" if view.max_range >= MIN_OUTDOOR_RANGE_M else unmeasured_note,
        "range_noise": unmeasured_note if np.isnan(pattern.range_noise) else "on smooth surfaces",
        "divergence": unmeasured_note,
        "reach": unmeasured_note,
        "silent": "no intensity in the clouds" if m.intensity is None else unmeasured_note,
    }


def _describe_origin(m: SensorMeasurement) -> str:
    count = f"{len(m.source.scans)} of {m.source.total}"
    return f"Measured by 'lidar-perception setup' from {count} clouds of {m.source.name}."


def _format_header(m: SensorMeasurement, *about: str) -> str:
    """Return comments that describe the file, followed by the warnings."""
    lines = (*about, *(f"Warning: {line}" for line in find_warnings(m)))
    return "\n".join(textwrap.fill(line, LINE_WIDTH, initial_indent="# ", subsequent_indent="#   ") for line in lines)


def _format_scalar(value: Any) -> str:
    is_short = isinstance(value, float) and round(value, 6) == float(f"{value:g}")
    return f"{value:g}" if is_short else str(value)


def _format_list(name: str, values: Sequence[float] | np.ndarray, digits: int) -> str:
    text = ", ".join(f"{round(float(v), digits) + 0.0:g}" for v in values)
    return textwrap.fill(f"{name}: [{text}]", LINE_WIDTH, subsequent_indent="  ", break_on_hyphens=False) + "\n"


def _format_tree(tree: Mapping[str, Any], indent: int) -> list[str]:
    lines, indentation = [], " " * indent
    for name, value in tree.items():
        if isinstance(value, dict):
            lines += [f"{indentation}{name}:", *_format_tree(value, indent + 2)]
            continue
        parameter_value, reason = value
        for line in reason.split("\n"):
            lines += textwrap.wrap(
                line, LINE_WIDTH - indent, initial_indent=f"{indentation}# ", subsequent_indent=f"{indentation}# "
            )
        lines.append(f"{indentation}{name}: {format_value(parameter_value)}")
    return lines
