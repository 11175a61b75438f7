"""A frame in perspective: points, clusters and boxes drawn with a depth buffer, in plain NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidar_perception.geometry import box_corners, points_in_box
from lidar_perception.scoring.pictures import save_picture
from lidar_perception.types import CLASSES

NEAR = 0.3  # metres before the eye; what is nearer is not drawn
SLACK = 0.15  # metres: points so little before an edge or face of a box do not hide it
EDGES = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4],
                  [0, 4], [1, 5], [2, 6], [3, 7]])
FRONT = [0, 3, 7, 4]  # the face that a box drives towards
FACES = [FRONT, [1, 2, 6, 5], [0, 1, 5, 4], [2, 3, 7, 6], [4, 5, 6, 7]]  # all but the bottom

SKY, FLOOR = np.array([0.035, 0.05, 0.085]), np.array([0.075, 0.095, 0.14])
GROUND, REST = np.array([0.36, 0.47, 0.62]), np.array([0.55, 0.60, 0.68])
# Neighbouring clusters differ; muted, so that boxes stand out.
CLUSTERS = np.array([
    [0.56, 0.47, 0.86], [0.33, 0.65, 0.62], [0.82, 0.56, 0.66], [0.50, 0.68, 0.38],
    [0.38, 0.56, 0.85], [0.80, 0.65, 0.42], [0.68, 0.42, 0.68], [0.42, 0.70, 0.80],
    [0.76, 0.50, 0.44], [0.58, 0.62, 0.46]])
# By class id, and again from the start for more classes.
CLASS_COLORS = np.array([
    [0.20, 0.80, 1.00], [0.30, 0.62, 1.00], [0.50, 0.55, 1.00], [1.00, 0.42, 0.32],
    [1.00, 0.52, 0.62], [1.00, 0.82, 0.22], [0.30, 0.90, 0.62], [0.85, 0.85, 0.90]])


@dataclass(frozen=True)
class View:
    """A pinhole camera. eye, target (x, y, z) metres, in the frame of the points; fov degrees from
    the left to the right edge; width, height of the picture in pixels. Up is z."""

    eye: tuple[float, float, float] = (-11.0, 0.0, 8.0)
    target: tuple[float, float, float] = (14.0, 0.0, -1.0)
    fov: float = 62.0
    width: int = 1600
    height: int = 800

    @property
    def focal(self) -> float:
        """Pixels."""
        return self.width / 2 / np.tan(np.radians(self.fov) / 2)

    def axes(self) -> np.ndarray:
        """(3, 3) float64 rows: the unit vectors to the right, down and ahead."""
        ahead = np.subtract(self.target, self.eye).astype(np.float64)
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(ahead, right), ahead])

    def seen(self, xyz: np.ndarray) -> np.ndarray:
        """(..., 3) float64 points (..., 3) relative to the eye: right, down, ahead, metres."""
        return (np.asarray(xyz, np.float64) - self.eye) @ self.axes().T

    def project(self, xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (..., 3) are in the picture: (..., 2) float64 column and row in pixels from
        the upper left corner, NaN nearer than NEAR or behind; and (...) metres ahead of the eye."""
        seen = self.seen(xyz)
        ahead = np.where(seen[..., 2] > NEAR, seen[..., 2], np.nan)
        return (seen[..., :2] / ahead[..., None] * self.focal
                + [self.width / 2, self.height / 2]), seen[..., 2]

    def larger(self, times: int) -> View:
        """The same view with so many times the pixels along each side."""
        return View(self.eye, self.target, self.fov, self.width * times, self.height * times)


@dataclass(frozen=True)
class Fragments:
    """Pixels that want to be drawn: place (F,) int64 row * width + column, depth (F,) float64
    metres, source (F,) int64 what each comes from."""

    place: np.ndarray
    depth: np.ndarray
    source: np.ndarray


def discs(view: View, pixels: np.ndarray, depth: np.ndarray, radius: np.ndarray) -> Fragments:
    """The pixels of discs around pixels (N, 2) with radius (N,), of one pixel at least; those of
    NaN, or outside the picture, are left out."""
    centre = np.floor(np.nan_to_num(pixels, nan=-1e9).clip(-1e9, 1e9)).astype(np.int64)
    reach = int(np.ceil(radius.max(initial=0.0)))
    outside = ((centre < -reach) | (centre >= [view.width + reach, view.height + reach])).any(1)
    inside = np.flatnonzero(~outside)
    parts = []
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            square = right * right + down * down
            drawn = inside[square <= radius[inside] ** 2] if square else inside
            column, row = centre[drawn, 0] + right, centre[drawn, 1] + down
            within = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
            drawn = drawn[within]
            parts.append((row[within] * view.width + column[within], depth[drawn], drawn))
    return Fragments(*(np.concatenate(column) for column in zip(*parts)))


def nearest(view: View, fragments: Fragments) -> tuple[np.ndarray, np.ndarray]:
    """The depth buffer: two (height * width,), float64 metres to the nearest fragment of each
    pixel, inf without one, and int64 the source it comes from, -1 without one."""
    depth = np.full(view.height * view.width, np.inf)
    np.minimum.at(depth, fragments.place, fragments.depth)
    source = np.full(len(depth), -1)
    first = fragments.depth == depth[fragments.place]
    source[fragments.place[first]] = fragments.source[first]
    return depth, source


def lines(view: View, start: np.ndarray, end: np.ndarray, radius: float) -> Fragments:
    """The pixels of the segments from start to end, (M, 3) each; what is nearer than NEAR is cut
    off. radius in pixels."""
    start, end = view.seen(start), view.seen(end)
    start, end = _beyond_near(start, end), _beyond_near(end, start)
    pixels = [e[:, :2] / e[:, 2:] * view.focal + [view.width / 2, view.height / 2]
              for e in (start, end)]
    length = np.abs(pixels[1] - pixels[0]).max(axis=1, initial=0.0)
    drawn = (start[:, 2] >= NEAR) & (end[:, 2] >= NEAR)
    count = np.where(drawn, np.ceil(length.clip(0, 4 * view.width)) + 1, 0).astype(np.int64)
    source = np.repeat(np.arange(len(count)), count)
    share = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
    share = share / np.maximum(count[source] - 1, 1)
    # The inverse of the depth, not the depth, is linear in the picture.
    depth = 1 / (1 / start[source, 2] * (1 - share) + 1 / end[source, 2] * share)
    along = pixels[0][source] * (1 - share)[:, None] + pixels[1][source] * share[:, None]
    fragments = discs(view, along, depth, np.full(len(along), radius))
    return Fragments(fragments.place, fragments.depth, source[fragments.source])


def _beyond_near(point: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Points (M, 3) moved towards the others until they are NEAR ahead, where these are."""
    rise = other[:, 2] - point[:, 2]
    share = np.where((point[:, 2] < NEAR) & (other[:, 2] > NEAR),
                     (NEAR - point[:, 2]) / np.where(rise == 0, 1, rise), 0)
    return point + share[:, None] * (other - point)


def shaded(depth: np.ndarray, reach: int, strength: float = 14.0) -> np.ndarray:
    """(H, W) float64 0..1, the light of each pixel of a depth map (H, W): less where neighbours
    reach pixels away are nearer, which sets things off from what is behind them (eye-dome
    lighting, Boucheny 2009)."""
    log = np.log2(np.where(np.isfinite(depth), depth, 1e4))
    around = np.pad(log, reach, mode="edge")
    height, width = depth.shape
    darker = np.zeros(depth.shape)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        other = around[reach * (1 + down):reach * (1 + down) + height,
                       reach * (1 + right):reach * (1 + right) + width]
        darker += (log - other).clip(0.0, 0.3)
    return np.exp(-strength * darker / 8)


def scene_colors(xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray,
                 boxes: np.ndarray, box_colors: np.ndarray) -> np.ndarray:
    """(N, 3) float64 0..1: ground blue-grey, clusters each in a colour, the rest grey; what is not
    ground in a box (K, 7) in the colour of the box (K, 3), bleached."""
    colors = np.where(ground[:, None], GROUND, REST)
    clustered = (cluster_ids > 0) & ~ground
    colors[clustered] = CLUSTERS[cluster_ids[clustered] * 7 % len(CLUSTERS)]
    for box, color in zip(boxes, box_colors):
        colors[points_in_box(xyz, box, 0.1) & ~ground] = 0.45 + 0.55 * color
    return colors


def render(view: View, xyz: np.ndarray, colors: np.ndarray, boxes: np.ndarray,
           box_colors: np.ndarray, *, point_size: float = 0.024, samples: int = 3,
           fog: float = 110.0) -> np.ndarray:
    """(height, width, 3) uint8: points (N, 3) with colors (N, 3) 0..1, boxes (K, 7) with box_colors
    (K, 3) as edges that points hide, the front face filled. point_size metres is a point's radius;
    samples along each side of a pixel are averaged; fog metres is where a colour has faded to
    a third. An empty cloud and no boxes give the background."""
    large = view.larger(samples)
    shape = large.height, large.width
    pixels, ahead = large.project(xyz)
    with np.errstate(divide="ignore", invalid="ignore"):
        radius = np.nan_to_num(point_size * large.focal / ahead).clip(0.7 * samples, 2.2 * samples)
    depth, source = nearest(large, discs(large, pixels, ahead, radius))
    rows = np.linspace(0, 1, large.height)[:, None, None]
    image = np.broadcast_to(SKY * (1 - rows) + FLOOR * rows, (*shape, 3)).reshape(-1, 3).copy()
    drawn = source >= 0
    light = shaded(depth.reshape(shape), samples).ravel()[drawn] * np.exp(-depth[drawn] / fog)
    image[drawn] = colors[source[drawn]] * light[:, None] + image[drawn] * (1 - light)[:, None]
    corners = box_corners(np.asarray(boxes, np.float64).reshape(-1, 7))
    for box in np.argsort(-np.linalg.norm(corners.mean(axis=1) - view.eye, axis=1)):
        image = _with_faces(large, image, depth, corners[box], box_colors[box])
    start, end = (corners[:, EDGES[:, i]].reshape(-1, 3) for i in (0, 1))
    edges, edge = nearest(large, lines(large, start, end, 0.75 * samples))
    for visible, opacity in ((edges <= depth + SLACK, 1.0), (edges > depth + SLACK, 0.3)):
        place = np.flatnonzero((edge >= 0) & visible)
        image[place] += opacity * (box_colors[edge[place] // len(EDGES)] - image[place])
    image = image.reshape(view.height, samples, view.width, samples, 3).mean(axis=(1, 3))
    return np.round(image.clip(0, 1) * 255).astype(np.uint8)


def _with_faces(view: View, image: np.ndarray, depth: np.ndarray, corners: np.ndarray,
                color: np.ndarray) -> np.ndarray:
    """The image (P, 3) with a veil of colour where the faces of a box (8, 3) are before depth
    (P,): a denser one on the front. Boxes that reach behind the eye get none."""
    pixels, ahead = view.project(corners)
    if not (ahead > NEAR).all():
        return image
    ends = [0, 0], [view.width, view.height]
    (left, top), (right, bottom) = (end.clip(*ends).astype(int) for end in (
        np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))))
    row, column = np.mgrid[top:bottom, left:right].reshape(2, -1)
    place, at = row * view.width + column, np.column_stack([column, row]) + 0.5
    image = image.copy()
    for face in FACES:
        start, end = pixels[face], pixels[np.roll(face, -1)]
        side = np.stack([(q[0] - p[0]) * (at[:, 1] - p[1]) - (q[1] - p[1]) * (at[:, 0] - p[0])
                         for p, q in zip(start, end)])
        inside = (side >= 0).all(axis=0) | (side <= 0).all(axis=0)
        # The inverse of the depth is linear in the picture.
        plane = np.linalg.lstsq(np.column_stack([start, np.ones(4)]), 1 / ahead[face],
                                rcond=None)[0]
        before = inside & (1 < (depth[place] + SLACK) * (at @ plane[:2] + plane[2]))
        image[place[before]] += (0.38 if face is FRONT else 0.07) * (color - image[place[before]])
    return image


def draw_scene(path: str | Path, xyz: np.ndarray, ground: np.ndarray, cluster_ids: np.ndarray,
               boxes: np.ndarray, class_ids: np.ndarray, *, view: View = View()) -> None:
    """Write a PNG of one frame in perspective: points xyz (N, 3), ground (N,) bool, cluster_ids
    (N,) int, 0 = none, boxes (K, 7) and class_ids (K,) into CLASSES. N and K may be 0. InputError
    where the file cannot be written."""
    import matplotlib
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    class_ids = np.asarray(class_ids, np.int64)
    box_colors = CLASS_COLORS[class_ids % len(CLASS_COLORS)]
    image = render(view, xyz, scene_colors(xyz, ground, cluster_ids, boxes, box_colors),
                   boxes, box_colors)
    figure = plt.figure(figsize=(view.width / 100, view.height / 100), dpi=100)
    figure.figimage(image)
    for i, class_id in enumerate(np.unique(class_ids)):
        figure.text(0.985, 0.955 - i * 0.05, CLASSES[class_id], ha="right", va="center",
                    fontsize=15, color=CLASS_COLORS[class_id % len(CLASS_COLORS)])
    save_picture(path, figure)
