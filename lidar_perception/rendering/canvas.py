"""An image to draw on: points with a depth, lines, filled polygons and text."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]  # r g b, 0..255
DASH, GAP = 7.0, 5.0  # lengths of dashes and gaps in pixels
MAX_RADIUS = 4  # maximum radius of a point in pixels
OUTLINE_COLOR = (10, 14, 22)  # outline of text
DEPTH_STEPS = np.uint16(65535)  # points are sorted by their rounded depth


class Text(NamedTuple):
    """A text on a canvas.

    Attributes:
        at: column and row.
        size: height in pixels.
        anchor: as in Pillow, such as "lm" (left, middle) or "mb" (middle, bottom).
    """

    at: tuple[float, float] | np.ndarray
    text: str
    color: Color
    size: int
    anchor: str = "mm"

    def shift(self, columns: float) -> Text:
        """Return the text shifted to the right."""
        column, row = self.at
        return self._replace(at=(column + columns, row))


class Canvas:
    """An image, pixels (height, width, 3) uint8 [r g b]. Coordinates are (column, row) in pixels.
    Parts outside the image are clipped. Later drawings cover earlier ones."""

    def __init__(self, width: int, height: int, color: ArrayLike = (0, 0, 0)) -> None:
        self.width, self.height = width, height
        self.pixels = np.empty((height, width, 3), np.uint8)
        self.pixels[:] = color

    def draw_points(self, at: np.ndarray, depth: np.ndarray, colors: np.ndarray, radius: np.ndarray) -> None:
        """Draw points as squares, near points over far ones.

        Args:
            at: (N, 2) positions.
            depth: (N,) distance from the eye.
            colors: (N, 3) uint8.
            radius: (N,) half of the side in pixels; it must not grow with the depth.
        """
        reach = MAX_RADIUS
        column, row = np.floor(at).T
        order = np.flatnonzero(
            (column >= -reach) & (column < self.width + reach) & (row >= -reach) & (row < self.height + reach)
        )
        if len(order) == 0:
            return
        depth = depth[order] - depth[order].min()
        steps = depth * (DEPTH_STEPS / max(depth.max(), 1e-6))
        order = order[np.argsort(DEPTH_STEPS - steps.astype(np.uint16), kind="stable")]  # radix sort for uint16
        cells = np.stack([column[order], row[order]], axis=1).astype(np.int32)
        # One packed number per pixel, in an image with a margin. The last of equal indices wins.
        stride = self.width + 2 * reach
        image = np.zeros((self.height + 2 * reach, stride, 4), np.uint8)
        image[reach:-reach, reach:-reach, :3] = self.pixels
        flat = image.view(np.uint32).ravel()
        packed = np.zeros((len(order), 4), np.uint8)
        packed[:, :3] = colors[order]
        values = packed.view(np.uint32).ravel()
        index = (cells[:, 1] + reach) * stride + cells[:, 0] + reach
        sides = np.clip(np.round(2 * radius[order]), 1, 2 * reach - 1).astype(np.int64)
        for side in np.unique(sides):  # from far to near, because the radius does not grow with the depth
            rows = sides == side
            shift = np.arange(side) - side // 2
            offsets = (shift[:, None] * stride + shift).ravel()
            spread = index[rows, None] + offsets
            flat[np.clip(spread, 0, len(flat) - 1)] = values[rows, None]
        self.pixels = np.ascontiguousarray(image[reach:-reach, reach:-reach, :3])

    def draw_lines(
        self, segments: ArrayLike, colors: ArrayLike, width: float = 1.5, alpha: ArrayLike = 1.0, dashed: bool = False
    ) -> None:
        """Draw antialiased lines.

        Args:
            segments: (S, 2, 2) start and end of each line.
            colors: (S, 3) or (3,).
            width: in pixels.
            alpha: (S,) or one number, 0..1.
        """
        segments = np.asarray(segments, np.float64).reshape(-1, 2, 2)
        kept, start, end = self._clip(segments, width)
        if not len(kept):
            return
        colors = np.broadcast_to(np.asarray(colors, np.float32), (len(segments), 3))[kept]
        opacity = np.broadcast_to(np.asarray(alpha, np.float32), len(segments))[kept]
        direction = end - start
        steep = np.abs(direction[:, 1]) > np.abs(direction[:, 0])
        # One sample per column (per row of a steep line), and several pixels across the line.
        main = np.where(
            steep[:, None], np.stack([start[:, 1], end[:, 1]], axis=1), np.stack([start[:, 0], end[:, 0]], axis=1)
        )
        cells = np.floor(main).astype(np.int64)
        count = np.abs(cells[:, 1] - cells[:, 0]) + 1
        owner = np.repeat(np.arange(len(kept)), count)
        step = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
        cell = cells.min(axis=1)[owner] + step
        share = (cell + 0.5 - main[owner, 0]) / np.where(direction.any(axis=1), main[:, 1] - main[:, 0], 1.0)[owner]
        share = np.clip(share, 0.0, 1.0)[:, None]
        at = start[owner] + share * direction[owner]
        length = np.maximum(np.hypot(*direction.T), 1e-9)
        if dashed:
            offset = np.linalg.norm(start - segments[kept, 0], axis=1)
            drawn = (offset[owner] + share[:, 0] * length[owner]) % (DASH + GAP) < DASH
            at, owner, cell = at[drawn], owner[drawn], cell[drawn]
        cosine = (np.abs(direction).max(axis=1) / length)[owner]  # cosine of the angle to the main axis
        reach = int(np.ceil(width)) + 1
        across = np.where(steep[owner], at[:, 0], at[:, 1])
        pixels = np.floor(across)[:, None] + np.arange(-reach, reach + 1)
        cover = np.clip(width / 2 + 0.5 - np.abs(pixels + 0.5 - across[:, None]) * cosine[:, None], 0.0, 1.0)
        column = np.where(steep[owner, None], pixels, cell[:, None])
        row = np.where(steep[owner, None], cell[:, None], pixels)
        self._blend(column, row, cover * opacity[owner, None], np.asarray(colors)[owner])

    def _blend(self, column: np.ndarray, row: np.ndarray, cover: np.ndarray, colors: np.ndarray) -> None:
        """Blend colors (M, 3) into the pixels at column and row (M, P) with opacity cover (M, P).
        The most opaque value of a pixel counts."""
        use = (cover > 0) & (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        index = (row[use] * self.width + column[use]).astype(np.int64)
        opaque, owner = cover[use], np.nonzero(use)[0]
        order = np.argsort(opaque, kind="stable")
        index, opaque, owner = index[order], opaque[order], owner[order]
        last = np.full(self.width * self.height, -1, np.int64)
        last[index] = np.arange(len(index))  # the last of equal indices wins
        chosen = last[last >= 0]
        flat = self.pixels.reshape(-1, 3)
        where, share = index[chosen], opaque[chosen, None]
        flat[where] = np.round(flat[where] * (1 - share) + colors[owner[chosen]] * share)

    def _clip(self, segments: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the indices of the K segments that touch the image, and start and end (K, 2) of
        their parts in it (Liang and Barsky, 1984)."""
        low = np.array([-width - 1.0] * 2)
        high = np.array([self.width, self.height]) + width + 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            start, direction = segments[:, 0], segments[:, 1] - segments[:, 0]
            a, b = (low - start) / direction, (high - start) / direction
        outside = (direction == 0) & ((start < low) | (start > high))
        enter = np.where(direction == 0, 0.0, np.minimum(a, b)).max(axis=1).clip(0.0)
        leave = np.where(direction == 0, 1.0, np.maximum(a, b)).min(axis=1).clip(max=1.0)
        kept = np.flatnonzero((enter < leave) & ~outside.any(axis=1) & np.isfinite(segments).all(axis=(1, 2)))
        return (
            kept,
            start[kept] + enter[kept, None] * direction[kept],
            start[kept] + leave[kept, None] * direction[kept],
        )

    def fill_polygon(self, corners: np.ndarray, color: ArrayLike, alpha: float = 1.0) -> None:
        """Fill a convex polygon with corners (C, 2)."""
        corners = np.asarray(corners, np.float64)
        if not np.isfinite(corners).all():
            return
        low = np.clip(np.floor(corners.min(axis=0)), 0, [self.width, self.height]).astype(int)
        high = np.clip(np.ceil(corners.max(axis=0)), 0, [self.width, self.height]).astype(int)
        if (high <= low).any():
            return
        x = np.arange(low[0], high[0]) + 0.5
        y = np.arange(low[1], high[1])[:, None] + 0.5
        sides = [
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
            for a, b in zip(corners, np.roll(corners, -1, axis=0))
        ]
        inside = np.all([side >= 0 for side in sides], axis=0) | np.all([side <= 0 for side in sides], axis=0)
        part = self.pixels[low[1] : high[1], low[0] : high[0]]
        part[inside] = np.round(part[inside] * (1 - alpha) + np.asarray(color) * alpha)

    def paste(self, other: Canvas, column: int, row: int) -> None:
        """Copy another canvas onto this one, with its top left corner at column and row."""
        self.pixels[row : row + other.height, column : column + other.width] = other.pixels

    def draw_texts(self, items: Sequence[Text]) -> None:
        """Draw texts with a dark outline."""
        if not items:
            return
        image = Image.fromarray(self.pixels)
        draw = ImageDraw.Draw(image)
        for at, text, color, size, anchor in items:
            draw.text(
                (float(at[0]), float(at[1])),
                text,
                fill=color,
                font=load_font(size),
                anchor=anchor,
                stroke_width=max(1, size // 9),
                stroke_fill=OUTLINE_COLOR,
            )
        self.pixels = np.array(image)


@lru_cache(maxsize=16)
def load_font(size: int) -> Any:
    """Load DejaVu Sans, which comes with matplotlib."""
    import matplotlib

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)
