"""The picture of a frame: perspective view on the left, bird's-eye view on the right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lidar_perception.geometry import box_corners, horizontal_range, points_in_boxes
from lidar_perception.rendering.canvas import Canvas, Text
from lidar_perception.rendering.colors import (
    BACKGROUND,
    DIM,
    GRID,
    LABEL,
    TEXT,
    color_by_height,
    color_by_intensity,
    get_class_color,
)
from lidar_perception.rendering.views import NEAR, BirdsEye, Perspective, View, project_lines
from lidar_perception.types import CLASSES, PointCloud

EDGES = np.array(
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]]
)  # of box_corners
FRONT, FLOOR = [0, 3, 7, 4], [0, 1, 2, 3]  # corners of the front and the bottom face
OTHER_FACES = [[1, 2, 6, 5], [0, 1, 5, 4], [2, 3, 7, 6], [4, 5, 6, 7]]
RING_POINTS = 180
MIN_RANGE, MAX_RANGE_AHEAD, MAX_RANGE_AROUND = 6.0, 55.0, 45.0  # limits of the displayed range in metres
POINT_SHARE = 5e-4  # radius of a point, as a fraction of the range
FOV = 60.0  # vertical field of view in degrees
FAR_PERCENTILE = 98  # percentile of the points' ranges that sets the range of a picture
BEV_SHARE = 0.375  # fraction of the width used by the bird's-eye view
CLASS_SHARE = 0.5  # weight of the class colour in the colour of points in boxes
ARROW_S = 1.0  # motion shown by an arrow, in seconds
SCALE_WIDTH = 110  # width of the colour scale in pixels
MIN_SPEED = 0.5  # in m/s; slower boxes have no arrow
NO_BOXES = np.zeros((0, 7))


@dataclass(frozen=True)
class Boxes:
    """K boxes to draw in the colours of their classes.

    Attributes:
        boxes: (K, 7) [x y z l w h yaw].
        class_ids: (K,).
        texts: K short strings to write above the boxes, or empty.
        trails: recent positions (N, 3) of each box, oldest first, or empty.
        velocities: (K, 2) m/s, or (0, 2).
    """

    boxes: np.ndarray = field(default_factory=lambda: NO_BOXES)
    class_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    texts: Sequence[str] = ()
    trails: Sequence[np.ndarray] = ()
    velocities: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True)
class Stage:
    """The settings shared by all pictures of a film.

    Attributes:
        reach: range that is shown, metres from the sensor.
        ahead: True to show the area ahead only, False for all around.
        ground: z of the ground at the sensor.
        color: colour of the points, "height" or "intensity".
        width, height: pixels.
    """

    reach: float
    ahead: bool
    ground: float
    color: str = "height"
    width: int = 1280
    height: int = 720

    @staticmethod
    def of(
        scan: PointCloud, sensor_height: float, ahead: bool, color: str = "height", size: tuple[int, int] = (1280, 720)
    ) -> Stage:
        """Return the stage for a film whose first scan is given."""
        far = np.percentile(horizontal_range(scan.xyz), FAR_PERCENTILE) if len(scan) else MIN_RANGE
        reach = float(np.clip(far, MIN_RANGE, MAX_RANGE_AHEAD if ahead else MAX_RANGE_AROUND))
        return Stage(reach, ahead, -sensor_height, color, *size)

    @property
    def views(self) -> tuple[Perspective, BirdsEye]:
        """The left view, from behind the sensor, and the bird's-eye view."""
        r, right = self.reach, round(self.width * BEV_SHARE)
        left = self.width - right
        if self.ahead:
            behind = Perspective(
                (-0.2 * r, -0.045 * r, 0.12 * r),
                (0.24 * r, 0.01 * r, self.ground),
                FOV,
                left,
                self.height,
                POINT_SHARE * r,
            )
            return behind, BirdsEye((0.44 * r, 0.0), self.height / (1.14 * r), right, self.height)
        behind = Perspective(
            (-0.5 * r, -0.1 * r, 0.4 * r), (0.02 * r, 0.0, self.ground), FOV, left, self.height, POINT_SHARE * r
        )
        return behind, BirdsEye((0.0, 0.0), self.height / (2.1 * r), right, self.height)

    @property
    def rings(self) -> np.ndarray:
        """Radii of the range rings on the ground, metres."""
        step = next(step for step in (1, 2, 5, 10, 20) if self.reach <= 6.5 * step)
        return np.arange(step, 1.6 * self.reach, step)

    def colors(self, scan: PointCloud) -> np.ndarray:
        """Return the colours (N, 3) uint8 of the points of a scan."""
        if self.color == "intensity" and scan.intensity is not None:
            return color_by_intensity(scan.intensity)
        return color_by_height(scan.xyz[:, 2] - np.float32(self.ground))


def draw_frame(
    stage: Stage,
    scan: PointCloud,
    found: Boxes,
    labels: np.ndarray = NO_BOXES,
    title: str = "",
    time: str = "",
    colors: np.ndarray | None = None,
) -> np.ndarray:
    """Draw a frame as an image (height, width, 3) uint8 [r g b].

    Args:
        found: boxes to draw.
        labels: (L, 7) labelled boxes, drawn dashed.
        title, time: texts at the top.
        colors: (N, 3) uint8 colours of the points; None: those of the stage.
    """
    scale = colors is None
    colors = highlight_points(stage.colors(scan) if colors is None else colors, scan.xyz, found)
    whole = Canvas(stage.width, stage.height, BACKGROUND)
    column, texts = 0, _make_heading(stage, title, time)
    for view in stage.views:
        canvas = Canvas(view.width, view.height, BACKGROUND)
        written = draw_view(canvas, view, stage, scan.xyz, colors, found, labels)
        whole.paste(canvas, column, 0)
        texts += [text.shift(column) for text in written]
        column += view.width
    left = stage.views[0].width
    whole.draw_lines([[[left, 0], [left, stage.height]]], GRID, 1.5)
    whole.draw_texts([*texts, *_draw_legend(whole, stage, found, labels, scale)])
    return whole.pixels


def highlight_points(colors: np.ndarray, xyz: np.ndarray, found: Boxes) -> np.ndarray:
    """Return the colours (N, 3) of points (N, 3), with light class colours for points in boxes."""
    colors = colors.copy()
    rows, first = points_in_boxes(xyz, found.boxes, 0.1)
    for k, class_id in enumerate(found.class_ids):
        inside = rows[first[k] : first[k + 1]]
        colors[inside] = CLASS_SHARE * np.array(get_class_color(class_id)) + (1 - CLASS_SHARE) * 240
    return colors


def draw_view(
    canvas: Canvas,
    view: View,
    stage: Stage,
    xyz: np.ndarray,
    colors: np.ndarray,
    found: Boxes,
    labels: np.ndarray = NO_BOXES,
) -> list[Text]:
    """Draw points (N, 3) in colors (N, 3), boxes and labels in one view; return its texts."""
    texts = _draw_rings(canvas, view, stage)
    pixels, depth = view.project(xyz)
    ahead = np.flatnonzero(depth > NEAR)
    canvas.draw_points(pixels[ahead], depth[ahead], colors[ahead], view.radius(depth[ahead]))
    _draw_sensor(canvas, view, stage)
    tints = np.array([get_class_color(c) for c in found.class_ids], float).reshape(-1, 3)
    boxes = found.boxes.astype(float)
    _draw_trails(canvas, view, found, tints)
    _draw_edges(canvas, view, labels.astype(float), np.tile(LABEL, (len(labels), 1)), 1.2, dashed=True)
    faces = [(FLOOR, 0.25)] if isinstance(view, BirdsEye) else [*((face, 0.05) for face in OTHER_FACES), (FRONT, 0.3)]
    ends, far = view.project(box_corners(boxes))
    for k in np.flatnonzero((far > NEAR).all(axis=1)):
        for face, alpha in faces:
            canvas.fill_polygon(ends[k, face], tints[k], alpha)
    _draw_edges(canvas, view, boxes, tints, 1.7)
    _draw_arrows(canvas, view, found, tints)
    return texts + _make_box_texts(view, found)


def _draw_rings(canvas: Canvas, view: View, stage: Stage) -> list[Text]:
    """Draw range rings on the ground; return their texts."""
    angles = np.linspace(0, 2 * np.pi, RING_POINTS)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(RING_POINTS)], axis=1)
    arcs = np.stack([circle[:-1], circle[1:]], axis=1)
    circles = stage.rings[:, None, None, None] * arcs + [0, 0, stage.ground]
    canvas.draw_lines(project_lines(view, circles.reshape(-1, 2, 3)), GRID, 1.2)
    places = np.stack([stage.rings * 0.8, stage.rings * -0.6, np.full(len(stage.rings), stage.ground)], axis=1)
    return [
        Text(at, f"{radius:g} m", DIM, 11)
        for at, far, radius in zip(*view.project(places), stage.rings)
        if far > NEAR and _has_room(view, at)
    ]


def _draw_sensor(canvas: Canvas, view: View, stage: Stage) -> None:
    """Draw an arrowhead at the sensor that points ahead."""
    size = 0.013 * stage.reach
    corners = np.array([[1.6, 0, 0], [-1, 1, 0], [-0.4, 0, 0], [-1, -1, 0]]) * size
    ends, depth = view.project(corners + [0, 0, stage.ground])
    if (depth > NEAR).all() and all(_has_room(view, end) for end in ends):
        canvas.fill_polygon(ends[[0, 1, 2]], TEXT, 0.9)
        canvas.fill_polygon(ends[[0, 2, 3]], TEXT, 0.7)


def _draw_trails(canvas: Canvas, view: View, found: Boxes, tints: np.ndarray) -> None:
    """Draw the trails of tracks on the ground, older parts fainter."""
    lines, colors, alphas = [np.zeros((0, 2, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for box, tint, trail in zip(found.boxes, tints, found.trails):
        low = np.asarray(trail, float) - [0, 0, box[5] / 2]
        lines.append(np.stack([low[:-1], low[1:]], axis=1))
        colors.append(np.tile(tint, (len(low) - 1, 1)))
        alphas.append(np.linspace(0.1, 0.9, len(low) - 1))
    canvas.draw_lines(project_lines(view, np.concatenate(lines)), np.concatenate(colors), 2.5, np.concatenate(alphas))


def _draw_edges(
    canvas: Canvas, view: View, boxes: np.ndarray, colors: np.ndarray, width: float, dashed: bool = False
) -> None:
    """Draw the edges of boxes (K, 7) in colors (K, 3). In the bird's-eye view: the bottom edges,
    and a line from the centre to the front."""
    corners = box_corners(boxes)
    if isinstance(view, BirdsEye):
        front = corners[:, [0, 3]].mean(axis=1)
        heading = np.stack([corners[:, :4].mean(axis=1), front], axis=1)[:, None]
        lines = np.concatenate([corners[:, EDGES[:4]], heading], axis=1)
    else:
        lines = corners[:, EDGES]
    colors = np.repeat(colors, lines.shape[1], axis=0)
    canvas.draw_lines(project_lines(view, lines.reshape(-1, 2, 3)), colors, width, dashed=dashed)


def _draw_arrows(canvas: Canvas, view: View, found: Boxes, tints: np.ndarray) -> None:
    """Draw arrows from moving boxes to their positions after ARROW_S."""
    speeds = np.hypot(*np.reshape(found.velocities, (-1, 2)).T)
    moving = np.flatnonzero(speeds >= MIN_SPEED)
    start, speed = found.boxes[moving, :3].astype(float), speeds[moving, None]
    ahead = np.pad(found.velocities[moving] / speed, ((0, 0), (0, 1)))
    sideways = ahead[:, [1, 0, 2]] * [-1, 1, 0]
    end, size = start + ahead * speed * ARROW_S, np.minimum(0.8, 0.4 * speed)
    lines = np.stack(
        [
            np.stack([start, end], axis=1),
            *(np.stack([end, end - size * (ahead + 0.5 * side * sideways)], axis=1) for side in (-1, 1)),
        ]
    )
    canvas.draw_lines(project_lines(view, lines.reshape(-1, 2, 3)), np.tile(tints[moving], (3, 1)), 1.7)


def _make_box_texts(view: View, found: Boxes) -> list[Text]:
    """Return the texts of the boxes, placed above them in the picture."""
    pixels, depth = view.project(box_corners(found.boxes.astype(float)))
    return [
        Text((ends[:, 0].mean(), ends[:, 1].min() - 2), text, get_class_color(class_id), 12, "mb")
        for ends, far, text, class_id in zip(pixels, depth, found.texts, found.class_ids)
        if text and (far > NEAR).all() and _has_room(view, ends.mean(axis=0))
    ]


def _has_room(view: View, at: np.ndarray) -> bool:
    """Return True if a text fits into the view at this pixel."""
    return bool(12 <= at[0] < view.width - 12 and 0 <= at[1] < view.height)


def _make_heading(stage: Stage, title: str, time: str) -> list[Text]:
    left = stage.views[0].width
    return [Text((16, 14), title, TEXT, 15, "lt"), Text((left - 16, 14), time, DIM, 15, "rt")]


def _draw_legend(canvas: Canvas, stage: Stage, found: Boxes, labels: np.ndarray, scale: bool) -> list[Text]:
    """Draw the colours of classes with their numbers of boxes, the line of labels, and the colour
    scale of the points; return the texts."""
    items, x, y = [], 18.0, stage.height - 20.0
    entries = [
        (f"{CLASSES[c]} {np.count_nonzero(found.class_ids == c)}", get_class_color(c), False)
        for c in np.unique(found.class_ids).tolist()
    ]
    if len(labels):
        entries.append((f"label {len(labels)}", LABEL, True))
    for text, color, dashed in entries:
        canvas.draw_lines([[[x, y], [x + 20, y]]], color, 3.0, dashed=dashed)
        items.append(Text((x + 27, y), text, TEXT, 14, "lm"))
        x += 50 + 8.2 * len(text)
    if not scale:
        return items
    right, top = stage.views[0].width - 80, int(y) - 4
    low, high, unit = (0, 1, "") if stage.color == "intensity" else (0, 4, " m")
    values = np.linspace(low, high, SCALE_WIDTH)
    bar = color_by_intensity(values) if stage.color == "intensity" else color_by_height(values)
    canvas.pixels[top : top + 8, right - SCALE_WIDTH : right] = bar
    return [
        *items,
        Text((right - SCALE_WIDTH - 6, y), f"{stage.color} {low}", DIM, 12, "rm"),
        Text((right + 6, y), f"{high}{unit}", DIM, 12, "lm"),
    ]
