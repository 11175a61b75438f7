"""The picture of a frame: on the left from behind the sensor, on the right from above."""

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
    by_height,
    by_intensity,
    class_color,
)
from lidar_perception.rendering.views import NEAR, BirdsEye, Perspective, View, before_eye
from lidar_perception.types import CLASSES, LidarFrame

EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4],
                  [0, 4], [1, 5], [2, 6], [3, 7]])  # of box_corners
FRONT, FLOOR = [0, 3, 7, 4], [0, 1, 2, 3]  # corners of the face that looks ahead, and below
OTHER_FACES = [[1, 2, 6, 5], [0, 1, 5, 4], [2, 3, 7, 6], [4, 5, 6, 7]]
RING_POINTS = 180
MIN_RANGE, MAX_RANGE_AHEAD, MAX_RANGE_AROUND = 6.0, 55.0, 45.0  # metres that a picture shows
POINT_SHARE = 5e-4  # of what a picture shows, the radius of a point
FOV = 60.0         # degrees, from left to right
FAR_SHARE = 98     # percent of the points that are in the picture
BEV_SHARE = 0.375  # of the width, for the view from above
INSIDE = 0.5       # share of their class's colour that points in boxes get
ARROW_S = 1.0      # seconds of motion that an arrow shows
SCALE_WIDTH = 110  # pixels, of the colours of the points
MIN_SPEED = 0.5    # m/s, from which on there is an arrow
NONE = np.zeros((0, 7))


@dataclass(frozen=True)
class Boxes:
    """K boxes to draw in the colours of their classes.

    boxes (K, 7) [x y z l w h yaw]; class_ids (K,); texts: K short strings, written above them;
    trails: recent positions (N, 3) of each, oldest first; velocities (K, 2), m/s. Texts, trails and
    velocities are empty where there are none.
    """

    boxes: np.ndarray = field(default_factory=lambda: NONE)
    class_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int32))
    texts: Sequence[str] = ()
    trails: Sequence[np.ndarray] = ()
    velocities: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True)
class Stage:
    """The settings shared by all pictures of a film.

    reach: metres from the sensor that are shown; ahead: False for all around; ground: z of the
    ground at the sensor; color: of the points, "height" or "intensity"; width, height: pixels.
    """

    reach: float
    ahead: bool
    ground: float
    color: str = "height"
    width: int = 1280
    height: int = 720

    @staticmethod
    def of(scan: LidarFrame, sensor_height: float, ahead: bool, color: str = "height",
           size: tuple[int, int] = (1280, 720)) -> Stage:
        """Return the stage of a film that begins with this scan."""
        far = np.percentile(horizontal_range(scan.xyz), FAR_SHARE) if len(scan) else MIN_RANGE
        reach = float(np.clip(far, MIN_RANGE, MAX_RANGE_AHEAD if ahead else MAX_RANGE_AROUND))
        return Stage(reach, ahead, -sensor_height, color, *size)

    @property
    def views(self) -> tuple[Perspective, BirdsEye]:
        """The view from behind, on the left, and the one from above."""
        r, right = self.reach, round(self.width * BEV_SHARE)
        left = self.width - right
        if self.ahead:
            behind = Perspective((-0.2 * r, -0.045 * r, 0.12 * r),
                                 (0.24 * r, 0.01 * r, self.ground), FOV, left, self.height,
                                 POINT_SHARE * r)
            return behind, BirdsEye((0.44 * r, 0.0), self.height / (1.14 * r), right, self.height)
        behind = Perspective((-0.5 * r, -0.1 * r, 0.4 * r), (0.02 * r, 0.0, self.ground),
                             FOV, left, self.height, POINT_SHARE * r)
        return behind, BirdsEye((0.0, 0.0), self.height / (2.1 * r), right, self.height)

    @property
    def rings(self) -> np.ndarray:
        """Radii of the circles on the ground, metres."""
        step = next(step for step in (1, 2, 5, 10, 20) if self.reach <= 6.5 * step)
        return np.arange(step, 1.6 * self.reach, step)

    def colors(self, scan: LidarFrame) -> np.ndarray:
        """Return (N, 3) uint8, the colours of the points of a scan."""
        if self.color == "intensity" and scan.intensity is not None:
            return by_intensity(scan.intensity)
        return by_height(scan.xyz[:, 2] - np.float32(self.ground))


def draw_frame(stage: Stage, scan: LidarFrame, found: Boxes, labels: np.ndarray = NONE,
               title: str = "", time: str = "", colors: np.ndarray | None = None) -> np.ndarray:
    """Draw a frame as (height, width, 3) uint8 [r g b]. labels (L, 7): labelled boxes, dashed;
    title and time: written at the top; colors (N, 3) uint8: of the points, instead of the
    stage's."""
    scale = colors is None
    colors = highlighted(stage.colors(scan) if colors is None else colors, scan.xyz, found)
    whole = Canvas(stage.width, stage.height, BACKGROUND)
    column, texts = 0, _heading(stage, title, time)
    for view in stage.views:
        canvas = Canvas(view.width, view.height, BACKGROUND)
        written = draw_view(canvas, view, stage, scan.xyz, colors, found, labels)
        whole.paste(canvas, column, 0)
        texts += [text.moved(column) for text in written]
        column += view.width
    left = stage.views[0].width
    whole.lines([[[left, 0], [left, stage.height]]], GRID, 1.5)
    whole.texts([*texts, *_legend(whole, stage, found, labels, scale)])
    return whole.pixels


def highlighted(colors: np.ndarray, xyz: np.ndarray, found: Boxes) -> np.ndarray:
    """Return the colours (N, 3) of points (N, 3), light ones of their class for those in boxes."""
    colors = colors.copy()
    rows, first = points_in_boxes(xyz, found.boxes, 0.1)
    for k, class_id in enumerate(found.class_ids):
        inside = rows[first[k]:first[k + 1]]
        colors[inside] = INSIDE * np.array(class_color(class_id)) + (1 - INSIDE) * 240
    return colors


def draw_view(canvas: Canvas, view: View, stage: Stage, xyz: np.ndarray, colors: np.ndarray,
              found: Boxes, labels: np.ndarray = NONE) -> list[Text]:
    """Draw one view of a frame with points (N, 3) in colors (N, 3), and return its texts."""
    texts = _rings(canvas, view, stage)
    pixels, depth = view.project(xyz)
    ahead = np.flatnonzero(depth > NEAR)
    canvas.points(pixels[ahead], depth[ahead], colors[ahead], view.radius(depth[ahead]))
    _sensor(canvas, view, stage)
    tints = np.array([class_color(c) for c in found.class_ids], float).reshape(-1, 3)
    boxes = found.boxes.astype(float)
    _trails(canvas, view, found, tints)
    _edges(canvas, view, labels.astype(float), np.tile(LABEL, (len(labels), 1)), 1.2, dashed=True)
    faces = [(FLOOR, 0.25)] if isinstance(view, BirdsEye) else [
        *((face, 0.05) for face in OTHER_FACES), (FRONT, 0.3)]
    ends, far = view.project(box_corners(boxes))
    for k in np.flatnonzero((far > NEAR).all(axis=1)):
        for face, alpha in faces:
            canvas.polygon(ends[k, face], tints[k], alpha)
    _edges(canvas, view, boxes, tints, 1.7)
    _arrows(canvas, view, found, tints)
    return texts + _names(view, found)


def _rings(canvas: Canvas, view: View, stage: Stage) -> list[Text]:
    """Draw circles on the ground, and return their radii."""
    angles = np.linspace(0, 2 * np.pi, RING_POINTS)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros(RING_POINTS)], axis=1)
    arcs = np.stack([circle[:-1], circle[1:]], axis=1)
    circles = stage.rings[:, None, None, None] * arcs + [0, 0, stage.ground]
    canvas.lines(before_eye(view, circles.reshape(-1, 2, 3)), GRID, 1.2)
    places = np.stack([stage.rings * 0.8, stage.rings * -0.6,
                       np.full(len(stage.rings), stage.ground)], axis=1)
    return [Text(at, f"{radius:g} m", DIM, 11)
            for at, far, radius in zip(*view.project(places), stage.rings)
            if far > NEAR and _inside(view, at)]


def _sensor(canvas: Canvas, view: View, stage: Stage) -> None:
    """Draw an arrowhead where the sensor is, which points ahead."""
    size = 0.013 * stage.reach
    corners = np.array([[1.6, 0, 0], [-1, 1, 0], [-0.4, 0, 0], [-1, -1, 0]]) * size
    ends, depth = view.project(corners + [0, 0, stage.ground])
    if (depth > NEAR).all() and all(_inside(view, end) for end in ends):
        canvas.polygon(ends[[0, 1, 2]], TEXT, 0.9)
        canvas.polygon(ends[[0, 2, 3]], TEXT, 0.7)


def _trails(canvas: Canvas, view: View, found: Boxes, tints: np.ndarray) -> None:
    """Draw where tracks were, on the ground below them, the older the fainter."""
    lines, colors, alphas = [np.zeros((0, 2, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for box, tint, trail in zip(found.boxes, tints, found.trails):
        low = np.asarray(trail, float) - [0, 0, box[5] / 2]
        lines.append(np.stack([low[:-1], low[1:]], axis=1))
        colors.append(np.tile(tint, (len(low) - 1, 1)))
        alphas.append(np.linspace(0.1, 0.9, len(low) - 1))
    canvas.lines(before_eye(view, np.concatenate(lines)), np.concatenate(colors), 2.5,
                 np.concatenate(alphas))


def _edges(canvas: Canvas, view: View, boxes: np.ndarray, colors: np.ndarray, width: float,
           dashed: bool = False) -> None:
    """Draw the edges of boxes (K, 7) in colors (K, 3); from above those below, and a line from the
    middle to the front."""
    corners = box_corners(boxes)
    if isinstance(view, BirdsEye):
        front = corners[:, [0, 3]].mean(axis=1)
        heading = np.stack([corners[:, :4].mean(axis=1), front], axis=1)[:, None]
        lines = np.concatenate([corners[:, EDGES[:4]], heading], axis=1)
    else:
        lines = corners[:, EDGES]
    colors = np.repeat(colors, lines.shape[1], axis=0)
    canvas.lines(before_eye(view, lines.reshape(-1, 2, 3)), colors, width, dashed=dashed)


def _arrows(canvas: Canvas, view: View, found: Boxes, tints: np.ndarray) -> None:
    """Draw arrows from moving boxes to where they will be after ARROW_S."""
    speeds = np.hypot(*np.reshape(found.velocities, (-1, 2)).T)
    moving = np.flatnonzero(speeds >= MIN_SPEED)
    start, speed = found.boxes[moving, :3].astype(float), speeds[moving, None]
    ahead = np.pad(found.velocities[moving] / speed, ((0, 0), (0, 1)))
    aside = ahead[:, [1, 0, 2]] * [-1, 1, 0]
    end, size = start + ahead * speed * ARROW_S, np.minimum(0.8, 0.4 * speed)
    lines = np.stack([np.stack([start, end], axis=1), *(
        np.stack([end, end - size * (ahead + 0.5 * side * aside)], axis=1) for side in (-1, 1))])
    canvas.lines(before_eye(view, lines.reshape(-1, 2, 3)), np.tile(tints[moving], (3, 1)), 1.7)


def _names(view: View, found: Boxes) -> list[Text]:
    """The texts of the boxes, above them in the picture."""
    pixels, depth = view.project(box_corners(found.boxes.astype(float)))
    return [Text((ends[:, 0].mean(), ends[:, 1].min() - 2), text, class_color(class_id), 12, "mb")
            for ends, far, text, class_id in zip(pixels, depth, found.texts, found.class_ids)
            if text and (far > NEAR).all() and _inside(view, ends.mean(axis=0))]


def _inside(view: View, at: np.ndarray) -> bool:
    """Return True if the view has room for a text at this pixel."""
    return bool(12 <= at[0] < view.width - 12 and 0 <= at[1] < view.height)


def _heading(stage: Stage, title: str, time: str) -> list[Text]:
    left = stage.views[0].width
    return [Text((16, 14), title, TEXT, 15, "lt"), Text((left - 16, 14), time, DIM, 15, "rt")]


def _legend(canvas: Canvas, stage: Stage, found: Boxes, labels: np.ndarray,
            scale: bool) -> list[Text]:
    """Draw which colour is which class, with its number of boxes, how labels are drawn, and the
    scale of the colours of the points; return the words."""
    items, x, y = [], 18.0, stage.height - 20.0
    entries = [(f"{CLASSES[c]} {np.count_nonzero(found.class_ids == c)}", class_color(c), False)
               for c in np.unique(found.class_ids).tolist()]
    if len(labels):
        entries.append((f"label {len(labels)}", LABEL, True))
    for text, color, dashed in entries:
        canvas.lines([[[x, y], [x + 20, y]]], color, 3.0, dashed=dashed)
        items.append(Text((x + 27, y), text, TEXT, 14, "lm"))
        x += 50 + 8.2 * len(text)
    if not scale:
        return items
    right, top = stage.views[0].width - 80, int(y) - 4
    low, high, unit = (0, 1, "") if stage.color == "intensity" else (0, 4, " m")
    values = np.linspace(low, high, SCALE_WIDTH)
    bar = by_intensity(values) if stage.color == "intensity" else by_height(values)
    canvas.pixels[top:top + 8, right - SCALE_WIDTH:right] = bar
    return [*items, Text((right - SCALE_WIDTH - 6, y), f"{stage.color} {low}", DIM, 12, "rm"),
            Text((right + 6, y), f"{high}{unit}", DIM, 12, "lm")]
