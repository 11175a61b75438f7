"""The files that a measured sensor becomes: its description, and parameters of the nodes."""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.clustering.density import adapt_to_density
from lidar_perception.clustering.params import FULL_DENSITY, ClusteringParams
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.robot.poses import transform_points
from lidar_perception.sensor_setup.doubts import (
    NOT_AHEAD,
    doubts,
    looks_elsewhere,
    may_be_backwards,
    turned,
)
from lidar_perception.sensor_setup.measure import SMALL_ROOM, Measured, sensor_of
from lidar_perception.sensor_setup.told import FOOTPRINT
from lidar_perception.simulation.sensor import Sensor
from lidar_perception.types import InputError

WIDTH = 98
# The paper's neighbourhoods (0.15, 0.30, 0.50 m up to 15, 30, 45 m) are this many times the
# distance of the HDL-64E's beams at the end of each band.
EPS_BEAMS = 1.33
LIMITS = (15.0, 30.0, 45.0)       # m, of the bands; the paper has the first two
MAX_EPS = (0.5, 0.7, 0.9, 1.0)    # m; farther neighbours join people who walk side by side
MIN_SAMPLES = 3
RESERVE = 0.75                    # of the density of a sensor, that no cloud of it counts as thin
UNREAD = 1e9                      # full intensity beside which any other is 0
GIVEN = "as --height-hint says; no ground in sight"
NEAREST_GROUND = 0.9              # of the distance of the nearest ground: where Patchwork++ begins


def sensor_yaml(m: Measured) -> str:
    """sensor.yaml: see simulation.sensor.sensor_from_file."""
    sensor = sensor_of(m)
    model = f"that of {m.model}" if m.model else "a default"
    why = {
        "height": f"+- {m.mount.error[0]:.3f}" if m.mount is not None else
        "not measured: no ground in sight" if m.hint is None else GIVEN,
        "rate": f"from {m.timing.by}" if np.isfinite(m.timing.rate) else "not measured",
        "azimuth_step": f"{sensor.columns} firings in a turn",
        "min_range": "the nearest that is not the robot's own" if m.least < sensor.min_range + 0.01
        else f"not measured; {model}",
        "max_range": "the farthest seen" if m.greatest >= SMALL_ROOM else f"not measured; {model}",
        "range_noise": f"not measured; {model}" if np.isnan(m.noise) else "about smooth surfaces",
        "divergence": f"not measured; {model}", "reach": f"not measured; {model}",
        "silent": "no intensity was seen" if m.intensity is None else f"not measured; {model}"}
    values = {"name": m.model or "measured", "height": sensor.height, "rate": sensor.rate,
              "azimuth_step": round(float(np.degrees(sensor.azimuth_step)), 6)}
    default = Sensor((0.0,), 0.1)
    values |= {"min_range": sensor.min_range, "max_range": sensor.max_range,
               "range_noise": sensor.range_noise, "reach": sensor.reach,
               "divergence": round(float(np.degrees(sensor.divergence)), 6)}
    values |= {name: getattr(sensor, name) for name in ("silent", "floor", "pulse", "dropout")
               if getattr(sensor, name) != getattr(default, name)}
    if sensor.wander:
        values["wander"] = round(float(np.degrees(sensor.wander)), 4)
    if sensor.fade != default.fade:
        values["fade"] = list(sensor.fade)
    out = _head(m, _origin(m), "Angles in degrees, lengths in metres; "
                "docs/how-to/own-sensor.md describes every field.") + "\n"
    out += "".join(f"{key}: {_plain(value)}" + (f"  # {why[key]}" if key in why else "") + "\n"
                   for key, value in values.items())
    out += _list("elevations", np.degrees(sensor.elevations), 4)
    if sensor.lifts:
        out += _list("lifts", sensor.lifts, 4)
    if sensor.blocked:
        out += "blocked:  # [first beam, from, to]: it and all lower ones see nothing there\n"
        out += "".join(f"- [{ring}, {a:g}, {b:g}]\n" for ring, a, b in sensor.blocked)
    return out


def _origin(m: Measured) -> str:
    return (f"Measured by 'lidar-perception setup' from {len(m.scans)} of {m.total} clouds of "
            f"{m.source}.")


def _head(m: Measured, *about: str) -> str:
    """Comments: what the file is about, and what is doubtful."""
    return "\n".join(part for text in (*about, *(f"Doubtful: {line}" for line in doubts(m)))
                     for part in textwrap.wrap(text, WIDTH, initial_indent="# ",
                                               subsequent_indent="#   "))


def _plain(value: Any) -> str:
    short = isinstance(value, float) and round(value, 6) == float(f"{value:g}")
    return f"{value:g}" if short else str(value)


def _list(name: str, values: Sequence[float] | np.ndarray, digits: int) -> str:
    text = ", ".join(f"{round(float(v), digits) + 0.0:g}" for v in values)
    return textwrap.fill(f"{name}: [{text}]", WIDTH, subsequent_indent="  ",
                         break_on_hyphens=False) + "\n"


def chosen_params(m: Measured) -> dict[str, tuple[Any, str]]:
    """Parameter of PipelineParams -> value and why: what the sensor and its mount ask for, and
    nothing that is as by default. InputError where a value is out of its parameter's range."""
    out: dict[str, tuple[Any, str]] = {}
    if m.intensity is not None:
        out["input.intensity_max"] = (m.intensity.full, f"intensities go up to "
                                      f"{m.intensity.greatest:.4g}" + ("" if m.intensity.sure
                                                                       else "; a guess"))
    elif m.scans[0].intensity is not None and m.scans[0].intensity.any():
        out["input.intensity_max"] = (UNREAD, "intensities are always the same, which says nothing:"
                                      " read as 0, as sensor.yaml has it")
    if m.coverage.fits:
        out["crop.body"] = (tuple(round(float(v), 2) for v in m.coverage.box),
                            f"around the robot's own returns, {100 * m.coverage.body_share:.1f} % "
                            f"of all; {100 * m.coverage.others:.0f} % of what is in it is not"
                            + _in_base(m))
    if m.mount is not None:
        q = m.mount
        out["ground.sensor_pose.height"] = (round(q.height, 3), f"+- {q.error[0]:.3f} m")
        for name, value, error in (("roll", q.roll, q.error[1]), ("pitch", q.pitch, q.error[2])):
            out[f"ground.sensor_pose.{name}"] = (
                round(value, 4), f"{np.degrees(value):.2f} +- {np.degrees(error):.2f} degrees")
        near = [np.percentile(np.hypot(*transform_points(s.xyz[p.on], q.pose)[:, :2].T), 1)
                for s, p in zip(m.scans, q.planes) if p is not None]
        start = round(NEAREST_GROUND * float(np.median(near)), 1)
        out["ground.patchwork.min_range"] = (start, "the nearest ground is "
                                             f"{float(np.median(near)):.1f} m away")
    elif m.hint is not None:
        out["ground.sensor_pose.height"] = (m.hint, GIVEN)
    reach = float(np.clip(np.ceil(m.greatest), 20.0, 200.0))
    if reach < 80.0 and m.greatest > SMALL_ROOM:
        out["ground.patchwork.max_range"] = (reach, "nothing is farther")
    if m.beams is not None and np.isfinite(m.step):
        out |= _of_resolution(m)
    try:
        with_values(PipelineParams(), {name: value for name, (value, _) in out.items()})
    except ValueError as error:
        raise InputError(f"{m.source}: what was measured is beyond what nodes take: {error}; give "
                         "clouds, in metres, of a sensor on a robot or a vehicle") from None
    return out


def _in_base(m: Measured) -> str:
    """Lines about the box around the body in base_frame, which nodes read it in, if they have one:
    around the corners of that in the sensor's frame."""
    pose, where = m.told.footprint, f"of '{FOOTPRINT}' by TF"
    if pose is None and m.mount is not None:
        pose = m.mount.pose
        where = "of a frame below the sensor that looks as it does (else add the sensor's place)"
    if pose is None:
        return "\nIt is in the sensor's frame. Nodes with base_frame read it in that."
    low, high = np.reshape(m.coverage.box, (2, 3))
    corners = transform_points(np.array([*itertools.product(*zip(low, high))]), pose)
    return (f"\nIt is in the sensor's frame. Nodes with base_frame read it in that; {where}:"
            f"\nbody: {_text((*corners.min(axis=0).round(2), *corners.max(axis=0).round(2)))}")


def node_params(m: Measured) -> dict[str, tuple[Any, str]]:
    """The same, and what only nodes have."""
    h, out = m.heading, chosen_params(m)
    if h is not None and looks_elsewhere(h) and not may_be_backwards(h):
        agreed = abs(turned(m.told.ahead - h.degrees)) <= NOT_AHEAD
        out["input.ahead"] = (
            float(round(m.told.ahead if agreed else h.degrees)), "where detectors look, which is "
            f"not along the clouds' x axis: {h.degrees:.0f} +- {h.error:.0f} degrees by the clouds"
            + (f", {m.told.ahead:.0f} by TF" if np.isfinite(m.told.ahead) else ""))
    return out


def _of_resolution(m: Measured) -> dict[str, tuple[Any, str]]:
    up, aside = m.elevation_step, m.step
    default = flatten(PipelineParams())
    density = (default["resolution.elevation_step"] * default["resolution.azimuth_step"]) / (
        up * aside)
    gaps = [np.radians(up) * limit for limit in (*LIMITS, LIMITS[-1] * 1.3)]
    paper = (*default["clustering.dbscan.eps"], 0.7)
    eps = tuple(round(float(min(max(EPS_BEAMS * gap, least), most)), 2)
                for gap, least, most in zip(gaps, paper, MAX_EPS))
    samples = int(np.clip(round(default["clustering.dbscan.min_samples"] * density), MIN_SAMPLES,
                          default["clustering.dbscan.min_samples"]))
    seen = 1.0 / (up * aside)
    made = adapt_to_density(ClusteringParams(density=FULL_DENSITY), seen).euclidean
    return {
        "clustering.dbscan.range_limits": (LIMITS, "a fourth band, as the resolution allows"),
        "clustering.dbscan.eps": (eps, f"{EPS_BEAMS} times the distance of the beams at the end "
                                  "of each band, at least the paper's, and less than what joins "
                                  "people"),
        "clustering.dbscan.join_bands": (True, "no cluster is cut at the end of a band"),
        "clustering.dbscan.min_samples": (samples, "10 for the HDL-64E; the sensor has "
                                          f"{density:.2f} times as many points on a surface"),
        "clustering.density": (round(min(FULL_DENSITY, RESERVE * seen), 2), "the numbers here are "
                               f"made for {seen:.1f} points a square degree; in thinner clouds "
                               "they follow the density"),
        "clustering.euclidean.min_size": (samples, "likewise"),
        "clustering.euclidean.radius": (round(made.radius, 2), "likewise"),
        "clustering.euclidean.beta": (round(made.beta, 2), "likewise"),
        "resolution.elevation_step": (round(up, 3), "between beams where people are, the median"),
        "resolution.azimuth_step": (round(aside, 3), "between points of a beam")}


def params_yaml(m: Measured) -> str:
    """robot.param.yaml: for every node, with what was chosen and why."""
    chosen = node_params(m)
    lines = [_head(m, f"{_origin(m)} What is not here is as by default. Of a parameter that a node "
                   "does not have it takes no notice."), "/**:"]
    tree: dict[str, Any] = {}
    for name, (value, why) in chosen.items():
        *path, last = name.split(".")
        at = tree
        for part in path:
            at = at.setdefault(part, {})
        at[last] = (value, why)
    lines += ["  ros__parameters:", *_tree(tree, 4)] if chosen else ["  ros__parameters: {}"]
    return "\n".join(lines) + "\n"


def _tree(tree: Mapping[str, Any], indent: int) -> list[str]:
    lines, pad = [], " " * indent
    for name, value in tree.items():
        if isinstance(value, dict):
            lines += [f"{pad}{name}:", *_tree(value, indent + 2)]
            continue
        number, why = value
        lines += [line for part in why.split("\n") for line in textwrap.wrap(
            part, WIDTH - indent, initial_indent=f"{pad}# ", subsequent_indent=f"{pad}# ")]
        lines.append(f"{pad}{name}: {_text(number)}")
    return lines


def _text(value: Any) -> str:
    """As YAML has it."""
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{float(v)}" for v in value) + "]"
    return str(value).lower() if isinstance(value, bool) else str(value)
