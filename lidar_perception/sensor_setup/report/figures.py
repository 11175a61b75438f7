"""Pictures of the report, drawn with Matplotlib as PNG bytes."""

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
from lidar_perception.sensor_setup.measurement.measure import SensorMeasurement
from lidar_perception.sensor_setup.measurement.scans import RETROREFLECTOR
from lidar_perception.sensor_setup.report.params import choose_params
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.types import PointCloud

BLUE, ORANGE, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#999999"  # Okabe and Ito, 2008
MAX_DRAWN_POINTS = 40_000
FIGURE_SIZE = (9.0, 4.0)  # inches
GROUND_RADIUS_M = 25.0  # of the drawn ground


def draw_figures(m: SensorMeasurement) -> dict[str, bytes]:
    """Return the pictures of everything that could be measured as PNG, by title."""
    pictures = {"Beams: elevation of each, and the scatter of its points": _draw_beams,
                "Ground: height of the points around above the fitted plane": _draw_ground,
                "The robot's body and blind sectors": _draw_coverage,
                "Intensities": _draw_intensities,
                "One scan with the parameters of robot.param.yaml: ground and clusters": _draw_scan}
    return {title: png for title, draw in pictures.items()
            if (png := _to_png(draw, m)) is not None}


def _to_png(draw: Any, m: SensorMeasurement) -> bytes | None:
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"font.size": 9, "legend.frameon": False}):
        figure = Figure(figsize=FIGURE_SIZE, dpi=110, layout="constrained")
        FigureCanvasAgg(figure)
        if not draw(figure, m):
            return None
        stream = BytesIO()
        figure.savefig(stream, format="png")
    return stream.getvalue()


def _draw_beams(figure: Any, m: SensorMeasurement) -> bool:
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    elevations = np.concatenate([scan.elevation for scan in m.source.scans])
    low, high = np.percentile(elevations, [0.1, 99.9])
    left.hist(elevations, np.linspace(low - 1, high + 1, 600), color=GREY, orientation="horizontal")
    left.set(xlabel="points", ylabel="elevation (deg)", title="points and beams")
    beams, model = m.pattern.beams, m.pattern.model
    if beams is None:
        right.text(0.5, 0.5, "no beams", ha="center")
        return True
    edge = left.get_xlim()[1]
    left.hlines(beams.elevations, 0, edge, color=BLUE, linewidth=0.4)
    difference = np.zeros(len(beams.elevations))
    if model:
        expected = np.degrees(find_sensor(model).elevations)
        difference = beams.elevations - expected[
            np.abs(beams.elevations[:, None] - expected).argmin(axis=1)]
    right.errorbar(difference, np.arange(len(difference)), xerr=beams.error, fmt=".", color=BLUE,
                   markersize=4)
    right.axvline(0.0, color=ORANGE, linewidth=0.8)
    limit = max(0.05, 1.2 * float((np.abs(difference) + beams.error).max()))
    right.set(xlabel="deg", ylabel="beam", xlim=(-limit, limit),
              title=f"difference to {model}" if model else "error of the elevation")
    right.invert_yaxis()
    return True


def _draw_ground(figure: Any, m: SensorMeasurement) -> bool:
    mount = m.mounting.mount
    if mount is None:
        return False
    i = next(k for k, plane in enumerate(mount.planes) if plane is not None)
    plane, scan = mount.planes[i], m.source.scans[i]
    assert plane is not None
    xyz = transform_points(scan.xyz, make_tilted_pose(plane.roll, plane.pitch, plane.height))
    near = np.hypot(*xyz[:, :2].T) < GROUND_RADIUS_M
    top, side = figure.subplots(1, 2)
    drawn = _sample(near)
    points = top.scatter(*xyz[drawn, :2].T, c=xyz[drawn, 2], s=0.6, cmap="coolwarm",
                         vmin=-0.3, vmax=0.3)
    figure.colorbar(points, ax=top, label="above the plane (m), cut at 0.3")
    top.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="from above")
    side.scatter(xyz[drawn, 0], xyz[drawn, 2], s=0.6, color=GREY, label="points")
    fitted = _sample(near & plane.on)
    side.scatter(xyz[fitted, 0], xyz[fitted, 2], s=0.8, color=GREEN, label="fitted")
    side.axhline(0.0, color=ORANGE, linewidth=0.8)
    side.plot([0], [plane.height], "^", color=ORANGE, markersize=5, label="sensor")
    side.set(ylim=(-0.8, plane.height + 1.0), xlabel="x (m)", ylabel="above the ground (m)",
             title="from the right, levelled")
    side.legend(markerscale=2, loc="upper right")
    return True


def _sample(mask: np.ndarray) -> np.ndarray:
    """Return indices where mask is true, at most MAX_DRAWN_POINTS."""
    found = np.flatnonzero(mask)
    return found[::max(1, -(-len(found) // MAX_DRAWN_POINTS))]


def _draw_coverage(figure: Any, m: SensorMeasurement) -> bool:
    from matplotlib.colors import ListedColormap
    c = m.view.coverage
    picture = np.where(c.body, 2, np.where(c.seen == 0, 1, 0))
    left, right = figure.subplots(1, 2, width_ratios=(3, 2))
    left.imshow(picture, aspect="auto", interpolation="nearest", vmin=0, vmax=2,
                extent=(0, 360, len(c.rows), 0),
                cmap=ListedColormap(["#dddddd", "#333333", ORANGE]))
    left.set(xlabel="azimuth (deg), 0 ahead, 90 left", ylabel="beam, 0 the highest",
             title="grey: seen, black: never a return, orange: body")
    scan = m.source.scans[0]
    near = _sample(np.hypot(*scan.xyz[:, :2].T) < 5.0)
    right.scatter(*scan.xyz[near, :2].T, s=0.8, color=GREY)
    if len(c.box):
        x0, y0, _, x1, y1, _ = c.box
        right.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=ORANGE)
    right.plot([0], [0], "^", color=BLUE)
    right.set(aspect="equal", xlim=(-5, 5), ylim=(-5, 5), xlabel="x (m)", ylabel="y (m)",
              title="around the sensor, with the body's box" if len(c.box) else "around the sensor")
    return True


def _draw_intensities(figure: Any, m: SensorMeasurement) -> bool:
    i = m.intensity
    if i is None:
        return False
    axis = figure.subplots()
    centres = (np.arange(len(i.histogram)) + 0.5) * i.full / len(i.histogram)
    axis.bar(centres, i.histogram, i.full / len(i.histogram) * 0.9, color=BLUE)
    axis.axvline(RETROREFLECTOR * i.full, color=ORANGE, linewidth=0.8)
    axis.set(yscale="log", xlabel="intensity in the cloud's scale", ylabel="points",
             title=f"{100 * i.zeros:.1f} % are 0, {100 * i.bright:.2f} % beyond the line are as "
                   "bright as retroreflectors")
    return True


def _draw_scan(figure: Any, m: SensorMeasurement) -> bool:
    values = {name: value for name, (value, _) in choose_params(m).items()}
    params = with_values(PipelineParams(), values)
    scan = m.source.scans[len(m.source.scans) // 2]
    intensity = None if scan.intensity is None else (
        scan.intensity / params.input.intensity_max if params.input.intensity_max else
        scan.intensity).astype(np.float32)
    frame = PointCloud(scan.xyz.astype(np.float32), intensity)
    _, frame = crop_frame(frame, params.crop)
    if m.mounting.mount is None:  # at an unknown height, furniture might count as ground
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
        axis.scatter(*frame.xyz[_sample(near & mask), :2].T, s=size, color=color, label=label)
    clustered = _sample(near & (labels > 0))
    axis.scatter(*frame.xyz[clustered, :2].T, s=1.2, c=labels[clustered] * 7 % 20, cmap="tab20",
                 label="clusters, by colour")
    axis.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title=f"{int(labels.max(initial=0))} "
             f"clusters; {100 * ground.mean():.0f} % of the points are ground")
    axis.legend(markerscale=5, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return True
