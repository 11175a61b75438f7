"""Canvas to draw points with depth, lines, filled polygons and text."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from PIL import Image, ImageDraw, ImageFont

Color = tuple[int, int, int]  # r g b, 0..255
DASH, GAP = 7.0, 5.0  # lengths of the dashes and gaps of a dashed line in pixels
MAX_RADIUS = 4  # maximum radius of a point in pixels
OUTLINE_COLOR = (10, 14, 22)  # colour of the outline of text
DEPTH_STEPS = np.uint16(65535)  # number of steps to which depths are rounded to sort points


class Text(NamedTuple):
    """Text to draw on a canvas.

    Attributes:
        position: Column and row of the anchor in pixels.
        text: String to draw.
        color: Colour of the letters.
        size: Height in pixels.
        anchor: Anchor as in Pillow, such as "lm" (left, middle) or "mb" (middle, bottom).
    """

    position: tuple[float, float] | np.ndarray
    text: str
    color: Color
    size: int
    anchor: str = "mm"

    def shift(self, columns: float) -> Text:
        """Return the text shifted to the right by `columns` pixels."""
        column, row = self.position
        return self._replace(position=(column + columns, row))


class Canvas:
    """Image with pixels (height, width, 3) uint8 [r g b].

    Coordinates are (column, row) in pixels. Parts outside the image are clipped. Later drawings
    cover earlier ones.
    """

    def __init__(self, width: int, height: int, color: ArrayLike = (0, 0, 0)) -> None:
        self.width, self.height = width, height
        self.pixels = np.empty((height, width, 3), np.uint8)
        self.pixels[:] = color

    def draw_points(self, positions: np.ndarray, depth: np.ndarray, colors: np.ndarray, radius: np.ndarray) -> None:
        """Draw points as squares; near points cover far ones.

        Args:
            positions: (N, 2) column and row of each point.
            depth: (N,) distance from the eye.
            colors: (N, 3) uint8.
            radius: (N,) half side of the squares in pixels, which must not increase with the depth.
        """
        margin = MAX_RADIUS
        column, row = np.floor(positions).T
        order = np.flatnonzero(
            (column >= -margin) & (column < self.width + margin) & (row >= -margin) & (row < self.height + margin)
        )
        if len(order) == 0:
            return
        depth = depth[order] - depth[order].min()
        depth_steps = depth * (DEPTH_STEPS / max(depth.max(), 1e-6))
        order = order[np.argsort(DEPTH_STEPS - depth_steps.astype(np.uint16), kind="stable")]  # radix sort for uint16
        cells = np.stack([column[order], row[order]], axis=1).astype(np.int32)
        # Each pixel is packed into one number, in an image with a margin. If an index occurs several
        # times, the last value is stored.
        stride = self.width + 2 * margin
        image = np.zeros((self.height + 2 * margin, stride, 4), np.uint8)
        image[margin:-margin, margin:-margin, :3] = self.pixels
        flat_pixels = image.view(np.uint32).ravel()
        packed_colors = np.zeros((len(order), 4), np.uint8)
        packed_colors[:, :3] = colors[order]
        values = packed_colors.view(np.uint32).ravel()
        first_pixel = (cells[:, 1] + margin) * stride + cells[:, 0] + margin
        sides = np.clip(np.round(2 * radius[order]), 1, 2 * margin - 1).astype(np.int64)
        for side in np.unique(sides):  # from far to near points, because the radius does not increase with the depth
            has_side = sides == side
            shift = np.arange(side) - side // 2
            offsets = (shift[:, None] * stride + shift).ravel()
            covered_pixels = first_pixel[has_side, None] + offsets
            flat_pixels[np.clip(covered_pixels, 0, len(flat_pixels) - 1)] = values[has_side, None]
        self.pixels = np.ascontiguousarray(image[margin:-margin, margin:-margin, :3])

    def draw_lines(
        self, segments: ArrayLike, colors: ArrayLike, width: float = 1.5, alpha: ArrayLike = 1.0, dashed: bool = False
    ) -> None:
        """Draw antialiased lines.

        Args:
            segments: (S, 2, 2) start and end of each line.
            colors: (S, 3), or (3,) for all lines.
            width: Line width in pixels.
            alpha: (S,) opacity 0..1, or one number for all lines.
            dashed: Draw dashed lines.
        """
        segments = np.asarray(segments, np.float64).reshape(-1, 2, 2)
        indices, start, end = self._clip(segments, width)
        if not len(indices):
            return
        colors = np.broadcast_to(np.asarray(colors, np.float32), (len(segments), 3))[indices]
        opacity = np.broadcast_to(np.asarray(alpha, np.float32), len(segments))[indices]
        direction = end - start
        is_steep = np.abs(direction[:, 1]) > np.abs(direction[:, 0])
        # Draw one sample per column, or per row of a steep line, with several pixels across the line.
        main_coordinate = np.where(
            is_steep[:, None], np.stack([start[:, 1], end[:, 1]], axis=1), np.stack([start[:, 0], end[:, 0]], axis=1)
        )
        cells = np.floor(main_coordinate).astype(np.int64)
        count = np.abs(cells[:, 1] - cells[:, 0]) + 1
        line_index = np.repeat(np.arange(len(indices)), count)
        step = np.arange(len(line_index)) - np.repeat(np.cumsum(count) - count, count)
        cell = cells.min(axis=1)[line_index] + step
        fraction = (cell + 0.5 - main_coordinate[line_index, 0]) / np.where(
            direction.any(axis=1), main_coordinate[:, 1] - main_coordinate[:, 0], 1.0
        )[line_index]
        fraction = np.clip(fraction, 0.0, 1.0)[:, None]
        centre = start[line_index] + fraction * direction[line_index]
        length = np.maximum(np.hypot(*direction.T), 1e-9)
        if dashed:
            clipped_length = np.linalg.norm(start - segments[indices, 0], axis=1)
            is_dash = (clipped_length[line_index] + fraction[:, 0] * length[line_index]) % (DASH + GAP) < DASH
            centre, line_index, cell = centre[is_dash], line_index[is_dash], cell[is_dash]
        cosine = (np.abs(direction).max(axis=1) / length)[line_index]  # cosine of the angle to the main axis
        half_count = int(np.ceil(width)) + 1
        cross_coordinate = np.where(is_steep[line_index], centre[:, 0], centre[:, 1])
        pixels = np.floor(cross_coordinate)[:, None] + np.arange(-half_count, half_count + 1)
        coverage = np.clip(
            width / 2 + 0.5 - np.abs(pixels + 0.5 - cross_coordinate[:, None]) * cosine[:, None], 0.0, 1.0
        )
        column = np.where(is_steep[line_index, None], pixels, cell[:, None])
        row = np.where(is_steep[line_index, None], cell[:, None], pixels)
        self._blend(column, row, coverage * opacity[line_index, None], np.asarray(colors)[line_index])

    def _blend(self, column: np.ndarray, row: np.ndarray, coverage: np.ndarray, colors: np.ndarray) -> None:
        """Blend colours into pixels; if a pixel occurs several times, the most opaque value is used.

        Args:
            column, row: (M, P) pixels.
            coverage: (M, P) opacity 0..1.
            colors: (M, 3) colours.
        """
        is_drawn = (coverage > 0) & (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        index = (row[is_drawn] * self.width + column[is_drawn]).astype(np.int64)
        opacities, color_index = coverage[is_drawn], np.nonzero(is_drawn)[0]
        order = np.argsort(opacities, kind="stable")
        index, opacities, color_index = index[order], opacities[order], color_index[order]
        last_entry = np.full(self.width * self.height, -1, np.int64)
        last_entry[index] = np.arange(len(index))  # if an index occurs several times, the last value is stored
        entries = last_entry[last_entry >= 0]
        flat_pixels = self.pixels.reshape(-1, 3)
        pixel_index, opacity = index[entries], opacities[entries, None]
        flat_pixels[pixel_index] = np.round(
            flat_pixels[pixel_index] * (1 - opacity) + colors[color_index[entries]] * opacity
        )

    def _clip(self, segments: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Clip segments to the image (Liang and Barsky, 1984).

        Returns:
            The indices (K,) of the segments that touch the image, and the start and end (K, 2) of
            the parts inside the image.
        """
        low = np.array([-width - 1.0] * 2)
        high = np.array([self.width, self.height]) + width + 1.0
        with np.errstate(divide="ignore", invalid="ignore"):
            start, direction = segments[:, 0], segments[:, 1] - segments[:, 0]
            low_fraction, high_fraction = (low - start) / direction, (high - start) / direction
        is_outside = (direction == 0) & ((start < low) | (start > high))
        enter_fraction = np.where(direction == 0, 0.0, np.minimum(low_fraction, high_fraction)).max(axis=1).clip(0.0)
        leave_fraction = (
            np.where(direction == 0, 1.0, np.maximum(low_fraction, high_fraction)).min(axis=1).clip(max=1.0)
        )
        indices = np.flatnonzero(
            (enter_fraction < leave_fraction) & ~is_outside.any(axis=1) & np.isfinite(segments).all(axis=(1, 2))
        )
        return (
            indices,
            start[indices] + enter_fraction[indices, None] * direction[indices],
            start[indices] + leave_fraction[indices, None] * direction[indices],
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
        edge_values = [
            (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])
            for a, b in zip(corners, np.roll(corners, -1, axis=0))
        ]
        is_inside = np.all([side >= 0 for side in edge_values], axis=0) | np.all(
            [side <= 0 for side in edge_values], axis=0
        )
        region = self.pixels[low[1] : high[1], low[0] : high[0]]
        region[is_inside] = np.round(region[is_inside] * (1 - alpha) + np.asarray(color) * alpha)

    def paste(self, other: Canvas, column: int, row: int) -> None:
        """Copy another canvas into this one, with its top left corner at (column, row)."""
        self.pixels[row : row + other.height, column : column + other.width] = other.pixels

    def draw_texts(self, items: Sequence[Text]) -> None:
        """Draw texts with a dark outline."""
        if not items:
            return
        image = Image.fromarray(self.pixels)
        draw = ImageDraw.Draw(image)
        for position, text, color, size, anchor in items:
            draw.text(
                (float(position[0]), float(position[1])),
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
    """Load the font DejaVu Sans, which is part of matplotlib."""
    import matplotlib

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", size)
