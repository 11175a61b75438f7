"""The pictures of the report, as PNG bytes, drawn with Matplotlib."""

from __future__ import annotations

from io import BytesIO
from typing import Any

import numpy as np

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.clustering.cluster import cluster
from lidar_perception.ground.segment import segment_ground
from lidar_perception.param_fields import with_values
from lidar_perception.robot.crop import crop_frame
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.robot.poses import transform_points
from lidar_perception.sensor_setup.files import chosen_params
from lidar_perception.sensor_setup.measure import Measured
from lidar_perception.sensor_setup.scans import RETROREFLECTOR
from lidar_perception.simulation.sensor import sensor_named
from lidar_perception.types import LidarFrame

BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#999999"  # Okabe and Ito, 2008
MAX_DRAWN = 40_000  # points
SIZE = (9.0, 4.0)   # inches


def drawn(m: Measured) -> dict[str, bytes]:
    """Title -> PNG, of what could be measured."""
    pictures = {"Beams: elevation of each, and how far its points scatter": _beams,
                "The ground: height of the points around above the plane that was fitted": _ground,
                "The robot's body and blind sectors": _coverage,
                "Intensities": _intensities,
                "One scan with the parameters of robot.param.yaml: ground and clusters": _scan}
    return {title: png for title, draw in pictures.items() if (png := _png(draw, m)) is not None}


def _png(draw: Any, m: Measured) -> bytes | None:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": 9, "legend.frameon": False}):
        figure = Figure(figsize=SIZE, dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        if not draw(figure, m):
            return None
        stream = BytesIO()
        figure.savefig(stream, format="png")
    return stream.getvalue()


def _beams(figure: Any, m: Measured) -> bool:
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    every = np.concatenate([scan.elevation for scan in m.scans])
    low, high = np.percentile(every, [0.1, 99.9])
    left.hist(every, np.linspace(low - 1, high + 1, 600), color=GREY, orientation="horizontal")
    left.set(xlabel="points", ylabel="elevation (deg)", title="points, and beams")
    if m.beams is None:
        right.text(0.5, 0.5, "no beams", ha="center")
        return True
    edge = left.get_xlim()[1]
    left.hlines(m.beams.elevations, 0, edge, color=BLUE, linewidth=0.4)
    known = np.degrees(sensor_named(m.model).elevations) if m.model else None
    off = np.zeros(len(m.beams.elevations)) if known is None else m.beams.elevations - known[
        np.abs(m.beams.elevations[:, None] - known).argmin(axis=1)]
    right.errorbar(off, np.arange(len(off)), xerr=m.beams.error, fmt=".", color=BLUE, markersize=4)
    right.axvline(0.0, color=ORANGE, linewidth=0.8)
    limit = max(0.05, 1.2 * float((np.abs(off) + m.beams.error).max()))
    right.set(xlabel="deg", ylabel="beam", xlim=(-limit, limit),
              title=f"elevation less that of {m.model}" if m.model else "error of the elevation")
    right.invert_yaxis()
    return True


def _ground(figure: Any, m: Measured) -> bool:
    if m.mount is None:
        return False
    i = next(k for k, plane in enumerate(m.mount.planes) if plane is not None)
    plane, scan = m.mount.planes[i], m.scans[i]
    assert plane is not None
    xyz = transform_points(scan.xyz, make_tilted_pose(plane.roll, plane.pitch, plane.height))
    near = np.hypot(*xyz[:, :2].T) < 25.0
    above, side = figure.subplots(1, 2)
    some = _some(near)
    on = above.scatter(*xyz[some, :2].T, c=xyz[some, 2], s=0.6, cmap="coolwarm",
                       vmin=-0.3, vmax=0.3)
    figure.colorbar(on, ax=above, label="above the plane (m), cut at 0.3")
    above.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="from above")
    side.scatter(xyz[some, 0], xyz[some, 2], s=0.6, color=GREY, label="points")
    used = _some(near & plane.on)
    side.scatter(xyz[used, 0], xyz[used, 2], s=0.8, color=GREEN, label="fitted")
    side.axhline(0.0, color=ORANGE, linewidth=0.8)
    side.plot([0], [plane.height], "^", color=ORANGE, markersize=5, label="sensor")
    side.set(ylim=(-0.8, plane.height + 1.0), xlabel="x (m)", ylabel="above the ground (m)",
             title="from the right, levelled")
    side.legend(markerscale=2, loc="upper right")
    return True


def _some(mask: np.ndarray) -> np.ndarray:
    """Indices where mask, MAX_DRAWN at most."""
    found = np.flatnonzero(mask)
    return found[::max(1, -(-len(found) // MAX_DRAWN))]


def _coverage(figure: Any, m: Measured) -> bool:
    from matplotlib.colors import ListedColormap
    c = m.coverage
    picture = np.where(c.body, 2, np.where(c.seen == 0, 1, 0))
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    left.imshow(picture, aspect="auto", interpolation="nearest", vmin=0, vmax=2,
                extent=(0, 360, len(c.rows), 0),
                cmap=ListedColormap(["#dddddd", "#333333", ORANGE]))
    left.set(xlabel="azimuth (deg), 0 ahead, 90 left", ylabel="beam, 0 the highest",
             title="grey: seen, black: never a return, orange: body")
    scan = m.scans[0]
    near = _some(np.hypot(*scan.xyz[:, :2].T) < 5.0)
    right.scatter(*scan.xyz[near, :2].T, s=0.8, color=GREY)
    if len(c.box):
        x0, y0, _, x1, y1, _ = c.box
        right.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=ORANGE)
    right.plot([0], [0], "^", color=BLUE)
    right.set(aspect="equal", xlim=(-5, 5), ylim=(-5, 5), xlabel="x (m)", ylabel="y (m)",
              title="around the sensor, with the body's box" if len(c.box) else "around the sensor")
    return True


def _intensities(figure: Any, m: Measured) -> bool:
    i = m.intensity
    if i is None:
        return False
    axis = figure.subplots()
    centres = (np.arange(len(i.histogram)) + 0.5) * i.full / len(i.histogram)
    axis.bar(centres, i.histogram, i.full / len(i.histogram) * 0.9, color=BLUE)
    axis.axvline(RETROREFLECTOR * i.full, color=ORANGE, linewidth=0.8)
    axis.set(yscale="log", xlabel="intensity as in the cloud", ylabel="points",
             title=f"{100 * i.zeros:.1f} % are 0, {100 * i.bright:.2f} % beyond the line as bright "
                   "as retroreflectors")
    return True


def _scan(figure: Any, m: Measured) -> bool:
    values = {name: value for name, (value, _) in chosen_params(m).items()}
    params = with_values(PipelineParams(), values)
    scan = m.scans[len(m.scans) // 2]
    intensity = None if scan.intensity is None else (
        scan.intensity / params.input.intensity_max if params.input.intensity_max else
        scan.intensity).astype(np.float32)
    frame = LidarFrame(scan.xyz.astype(np.float32), intensity)
    _, frame = crop_frame(frame, params.crop)
    if m.mount is None:  # a plane at an unknown height would take furniture for ground
        ground = np.zeros(len(frame), bool)
    else:
        ground = segment_ground(frame, params.ground)
    labels = np.zeros(len(frame), np.int64)
    upright = np.flatnonzero(~ground)
    labels[upright] = cluster(frame.xyz[upright], params.clustering)
    half = float(np.clip(np.percentile(np.abs(frame.xyz[:, :2]).max(axis=1), 95), 5.0, 45.0))
    near = (np.abs(frame.xyz[:, :2]) < half).all(axis=1)
    axis = figure.subplots()
    for mask, color, size, label in ((ground, "#9aa8b8", 0.5, "ground"),
                                     (~ground & (labels == 0), "#cccccc", 0.5, "neither")):
        axis.scatter(*frame.xyz[_some(near & mask), :2].T, s=size, color=color, label=label)
    shown = _some(near & (labels > 0))
    axis.scatter(*frame.xyz[shown, :2].T, s=1.2, c=labels[shown] * 7 % 20, cmap="tab20",
                 label="clusters, each in a colour")
    axis.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"{int(labels.max(initial=0))} "
             f"clusters; {100 * ground.mean():.0f} % of the points are ground")
    axis.legend(markerscale=5, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return True
