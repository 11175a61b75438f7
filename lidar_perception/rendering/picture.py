"""Drawing of a frame as an image: perspective view on the left, bird's-eye view on the right."""

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
)  # edges of a box as pairs of corners, see box_corners
FRONT, FLOOR = [0, 3, 7, 4], [0, 1, 2, 3]  # corners of the front and the bottom face
OTHER_FACES = [[1, 2, 6, 5], [0, 1, 5, 4], [2, 3, 7, 6], [4, 5, 6, 7]]  # corners of the other faces
RING_POINTS = 180  # number of points with which a range ring is drawn
MIN_RANGE, MAX_RANGE_AHEAD, MAX_RANGE_AROUND = 6.0, 55.0, 45.0  # limits of the displayed range in metres
POINT_RADIUS_FRACTION = 5e-4  # radius of a point as a fraction of the displayed range
FOV = 60.0  # horizontal field of view in degrees
# Eye (x, y, z) and target (x, y) of the perspective view, and x of the centre and height of the bird's-eye view,
# as fractions of the displayed range.
AHEAD_VIEW = (-0.2, -0.045, 0.12), (0.24, 0.01), 0.44, 1.14
AROUND_VIEW = (-0.5, -0.1, 0.4), (0.02, 0.0), 0.0, 2.1
RANGE_PERCENTILE = 98  # percentile of the points' ranges that is chosen as displayed range
BEV_FRACTION = 0.375  # fraction of the width used by the bird's-eye view
CLASS_COLOR_WEIGHT = 0.5  # weight of the class colour in the colour of points in boxes
ARROW_S = 1.0  # duration of the motion that an arrow shows, in seconds
SCALE_WIDTH = 110  # width of the colour scale in pixels
MIN_SPEED = 0.5  # minimum speed of boxes with an arrow, in m/s
NO_BOXES = np.zeros((0, 7))


@dataclass(frozen=True)
class Boxes:
    """K boxes to draw in the colours of their classes.

    Attributes:
        boxes: (K, 7) [x y z l w h yaw].
        class_ids: (K,) indices into CLASSES.
        texts: K short strings to write above the boxes; empty for none.
        trails: Recent positions (N, 3) of each box, oldest first; empty for none.
        velocities: (K, 2) m/s; (0, 2) for no arrows.
    """

    boxes: np.ndarray = field(default_factory=lambda: NO_BOXES)
    class_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    texts: Sequence[str] = ()
    trails: Sequence[np.ndarray] = ()
    velocities: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True)
class RenderSettings:
    """Settings shared by all images of a video.

    Attributes:
        reach: Displayed range around the sensor, metres.
        ahead: True to show only the area ahead of the sensor, False to show all directions.
        ground: z of the ground at the sensor, metres.
        color: Value that determines the colours of the points, "height" or "intensity".
        width, height: Size of an image in pixels.
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
    ) -> RenderSettings:
        """Choose the settings for a video, given its first scan."""
        typical_range = np.percentile(horizontal_range(scan.xyz), RANGE_PERCENTILE) if len(scan) else MIN_RANGE
        extent = float(np.clip(typical_range, MIN_RANGE, MAX_RANGE_AHEAD if ahead else MAX_RANGE_AROUND))
        return RenderSettings(extent, ahead, -sensor_height, color, *size)

    @property
    def views(self) -> tuple[Perspective, BirdsEye]:
        """Perspective view from behind the sensor, and bird's-eye view."""
        extent, right_width = self.reach, round(self.width * BEV_FRACTION)
        left_width = self.width - right_width
        eye, target, centre_x, height = AHEAD_VIEW if self.ahead else AROUND_VIEW
        perspective = Perspective(
            (eye[0] * extent, eye[1] * extent, eye[2] * extent),
            (target[0] * extent, target[1] * extent, self.ground),
            FOV,
            left_width,
            self.height,
            POINT_RADIUS_FRACTION * extent,
        )
        scale = self.height / (height * extent)
        return perspective, BirdsEye((centre_x * extent, 0.0), scale, right_width, self.height)

    @property
    def ring_radii(self) -> np.ndarray:
        """Radii of the range rings on the ground, metres."""
        step = next(step for step in (1, 2, 5, 10, 20) if self.reach <= 6.5 * step)
        return np.arange(step, 1.6 * self.reach, step)

    def color_points(self, scan: PointCloud) -> np.ndarray:
        """Return the colours (N, 3) uint8 of the points of a scan."""
        if self.color == "intensity" and scan.intensity is not None:
            return color_by_intensity(scan.intensity)
        return color_by_height(scan.xyz[:, 2] - np.float32(self.ground))


def draw_frame(
    settings: RenderSettings,
    scan: PointCloud,
    boxes: Boxes,
    labels: np.ndarray = NO_BOXES,
    title: str = "",
    time: str = "",
    colors: np.ndarray | None = None,
) -> np.ndarray:
    """Draw a frame as an image (height, width, 3) uint8 [r g b].

    Args:
        settings: Settings of the image.
        scan: Cloud of N points.
        boxes: Boxes to draw.
        labels: (L, 7) labelled boxes, which are drawn with dashed lines.
        title, time: Texts at the top left and right.
        colors: (N, 3) uint8 colours of the points; None for the colours of `settings`.
    """
    with_scale = colors is None
    colors = highlight_points(settings.color_points(scan) if colors is None else colors, scan.xyz, boxes)
    image = Canvas(settings.width, settings.height, BACKGROUND)
    left_width = settings.views[0].width
    texts = [Text((16, 14), title, TEXT, 15, "lt"), Text((left_width - 16, 14), time, DIM, 15, "rt")]
    left_column = 0
    for view in settings.views:
        canvas = Canvas(view.width, view.height, BACKGROUND)
        view_texts = draw_view(canvas, view, settings, scan.xyz, colors, boxes, labels)
        image.paste(canvas, left_column, 0)
        texts += [text.shift(left_column) for text in view_texts]
        left_column += view.width
    image.draw_lines([[[left_width, 0], [left_width, settings.height]]], GRID, 1.5)
    image.draw_texts([*texts, *_draw_legend(image, settings, boxes, labels, with_scale)])
    return image.pixels


def highlight_points(colors: np.ndarray, xyz: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Return colours (N, 3) in which points in a box have a light version of its class colour."""
    colors = colors.copy()
    rows, first_rows = points_in_boxes(xyz, boxes.boxes, 0.1)
    for k, class_id in enumerate(boxes.class_ids):
        indices = rows[first_rows[k] : first_rows[k + 1]]
        colors[indices] = CLASS_COLOR_WEIGHT * np.array(get_class_color(class_id)) + (1 - CLASS_COLOR_WEIGHT) * 240
    return colors


def draw_view(
    canvas: Canvas,
    view: View,
    settings: RenderSettings,
    xyz: np.ndarray,
    colors: np.ndarray,
    detections: Boxes,
    labels: np.ndarray = NO_BOXES,
) -> list[Text]:
    """Draw points (N, 3) in colors (N, 3), boxes and labels in one view.

    Returns:
        The texts to draw on top.
    """
    texts = _draw_rings(canvas, view, settings)
    pixels, depth = view.project(xyz)
    in_front = np.flatnonzero(depth > NEAR)
    canvas.draw_points(pixels[in_front], depth[in_front], colors[in_front], view.find_radii(depth[in_front]))
    _draw_sensor(canvas, view, settings)
    box_colors = np.array([get_class_color(c) for c in detections.class_ids], float).reshape(-1, 3)
    boxes = detections.boxes.astype(float)
    _draw_trails(canvas, view, detections, box_colors)
    _draw_edges(canvas, view, labels.astype(float), np.tile(LABEL, (len(labels), 1)), 1.2, dashed=True)
    faces = [(FLOOR, 0.25)] if isinstance(view, BirdsEye) else [*((face, 0.05) for face in OTHER_FACES), (FRONT, 0.3)]
    corner_pixels, corner_depths = view.project(box_corners(boxes))
    for k in np.flatnonzero((corner_depths > NEAR).all(axis=1)):
        for face, alpha in faces:
            canvas.fill_polygon(corner_pixels[k, face], box_colors[k], alpha)
    _draw_edges(canvas, view, boxes, box_colors, 1.7)
    _draw_arrows(canvas, view, detections, box_colors)
    return texts + _make_box_texts(view, detections)


def _draw_rings(canvas: Canvas, view: View, settings: RenderSettings) -> list[Text]:
    """Draw range rings on the ground; return their captions."""
    angles = np.linspace(0, 2 * np.pi, RING_POINTS)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(RING_POINTS)], axis=1)
    arcs = np.stack([circle[:-1], circle[1:]], axis=1)
    circles = settings.ring_radii[:, None, None, None] * arcs + [0, 0, settings.ground]
    canvas.draw_lines(project_lines(view, circles.reshape(-1, 2, 3)), GRID, 1.2)
    text_positions = np.stack(
        [settings.ring_radii * 0.8, settings.ring_radii * -0.6, np.full(len(settings.ring_radii), settings.ground)],
        axis=1,
    )
    return [
        Text(pixel, f"{radius:g} m", DIM, 11)
        for pixel, depth, radius in zip(*view.project(text_positions), settings.ring_radii)
        if depth > NEAR and _has_room(view, pixel)
    ]


def _draw_sensor(canvas: Canvas, view: View, settings: RenderSettings) -> None:
    """Draw an arrowhead at the position of the sensor that points forward."""
    size = 0.013 * settings.reach
    corners = np.array([[1.6, 0, 0], [-1, 1, 0], [-0.4, 0, 0], [-1, -1, 0]]) * size
    pixels, depth = view.project(corners + [0, 0, settings.ground])
    if (depth > NEAR).all() and all(_has_room(view, end) for end in pixels):
        canvas.fill_polygon(pixels[[0, 1, 2]], TEXT, 0.9)
        canvas.fill_polygon(pixels[[0, 2, 3]], TEXT, 0.7)


def _draw_trails(canvas: Canvas, view: View, boxes: Boxes, box_colors: np.ndarray) -> None:
    """Draw the trails of tracks on the ground; older parts are fainter."""
    lines, colors, alphas = [np.zeros((0, 2, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for box, box_color, trail in zip(boxes.boxes, box_colors, boxes.trails):
        on_ground = np.asarray(trail, float) - [0, 0, box[5] / 2]
        lines.append(np.stack([on_ground[:-1], on_ground[1:]], axis=1))
        colors.append(np.tile(box_color, (len(on_ground) - 1, 1)))
        alphas.append(np.linspace(0.1, 0.9, len(on_ground) - 1))
    canvas.draw_lines(project_lines(view, np.concatenate(lines)), np.concatenate(colors), 2.5, np.concatenate(alphas))


def _draw_edges(
    canvas: Canvas, view: View, boxes: np.ndarray, colors: np.ndarray, width: float, dashed: bool = False
) -> None:
    """Draw the edges of boxes (K, 7) in colors (K, 3).

    In the bird's-eye view, draw the bottom edges and a line from the centre to the front.
    """
    corners = box_corners(boxes)
    if isinstance(view, BirdsEye):
        front = corners[:, [0, 3]].mean(axis=1)
        heading = np.stack([corners[:, :4].mean(axis=1), front], axis=1)[:, None]
        lines = np.concatenate([corners[:, EDGES[:4]], heading], axis=1)
    else:
        lines = corners[:, EDGES]
    colors = np.repeat(colors, lines.shape[1], axis=0)
    canvas.draw_lines(project_lines(view, lines.reshape(-1, 2, 3)), colors, width, dashed=dashed)


def _draw_arrows(canvas: Canvas, view: View, boxes: Boxes, box_colors: np.ndarray) -> None:
    """Draw an arrow from each moving box to its position after ARROW_S."""
    speeds = np.hypot(*np.reshape(boxes.velocities, (-1, 2)).T)
    moving_indices = np.flatnonzero(speeds >= MIN_SPEED)
    start, speed = boxes.boxes[moving_indices, :3].astype(float), speeds[moving_indices, None]
    direction = np.pad(boxes.velocities[moving_indices] / speed, ((0, 0), (0, 1)))
    sideways = direction[:, [1, 0, 2]] * [-1, 1, 0]
    end, head_length = start + direction * speed * ARROW_S, np.minimum(0.8, 0.4 * speed)
    lines = np.stack(
        [
            np.stack([start, end], axis=1),
            *(np.stack([end, end - head_length * (direction + 0.5 * side * sideways)], axis=1) for side in (-1, 1)),
        ]
    )
    canvas.draw_lines(project_lines(view, lines.reshape(-1, 2, 3)), np.tile(box_colors[moving_indices], (3, 1)), 1.7)


def _make_box_texts(view: View, boxes: Boxes) -> list[Text]:
    """Return the texts of the boxes, placed above them in the image."""
    pixels, depth = view.project(box_corners(boxes.boxes.astype(float)))
    return [
        Text((corners[:, 0].mean(), corners[:, 1].min() - 2), text, get_class_color(class_id), 12, "mb")
        for corners, corner_depths, text, class_id in zip(pixels, depth, boxes.texts, boxes.class_ids)
        if text and (corner_depths > NEAR).all() and _has_room(view, corners.mean(axis=0))
    ]


def _has_room(view: View, pixel: np.ndarray) -> bool:
    """Return True if a text fits into the view at this pixel."""
    return bool(12 <= pixel[0] < view.width - 12 and 0 <= pixel[1] < view.height)


def _draw_legend(
    canvas: Canvas, settings: RenderSettings, boxes: Boxes, labels: np.ndarray, with_scale: bool
) -> list[Text]:
    """Draw the legend: box counts of classes, labels, and colour scale. Return the texts to draw on top."""
    items, x, y = [], 18.0, settings.height - 20.0
    entries = [
        (f"{CLASSES[c]} {np.count_nonzero(boxes.class_ids == c)}", get_class_color(c), False)
        for c in np.unique(boxes.class_ids).tolist()
    ]
    if len(labels):
        entries.append((f"label {len(labels)}", LABEL, True))
    for text, color, dashed in entries:
        canvas.draw_lines([[[x, y], [x + 20, y]]], color, 3.0, dashed=dashed)
        items.append(Text((x + 27, y), text, TEXT, 14, "lm"))
        x += 50 + 8.2 * len(text)
    if not with_scale:
        return items
    scale_right = settings.views[0].width - 80
    if x > scale_right - SCALE_WIDTH - 80:  # not enough width for one row
        y -= 24
    scale_top = int(y) - 4
    low, high, unit = (0, 1, "") if settings.color == "intensity" else (0, 4, " m")
    values = np.linspace(low, high, SCALE_WIDTH)
    bar = color_by_intensity(values) if settings.color == "intensity" else color_by_height(values)
    canvas.pixels[scale_top : scale_top + 8, scale_right - SCALE_WIDTH : scale_right] = bar
    return [
        *items,
        Text((scale_right - SCALE_WIDTH - 6, y), f"{settings.color} {low}", DIM, 12, "rm"),
        Text((scale_right + 6, y), f"{high}{unit}", DIM, 12, "lm"),
    ]
