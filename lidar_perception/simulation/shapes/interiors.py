"""Wall segments and furniture of interiors.

Each function returns (P,) PART. Wall segments are centred along x, with their face at y = 0 facing -y.
Furniture faces +x.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.shapes.furniture import BUILDING, FOOT_M, OTHER
from lidar_perception.simulation.shapes.primitives import GLASS, METAL, RUBBER, block, cylinder, disc, rod
from lidar_perception.simulation.solids import make_parts

DOOR_HEIGHT_M = 2.1
WALL_THICKNESS_M = 0.2


def make_wall(rng: np.random.Generator, length: float, height: float) -> np.ndarray:
    """Make a wall with a skirting board, some with a handrail, a notice board or a picture."""
    x = length / 2
    rows = [
        _make_wall_panel((-x, x), FOOT_M, height, rng),
        block((-x, -0.015, 0.0), (x, 0.0, 0.1), rng.uniform(0.1, 0.5)),
    ]
    pick = rng.random()
    if pick < 0.15:
        rows.append(block((-x, -0.08, 0.85), (x, -0.03, 0.95), 0.3))
    elif pick < 0.45 and length > 1.5:
        half_width, low = rng.uniform(0.3, 0.45) * length, rng.uniform(0.9, 1.3)
        rows.append(
            block((-half_width, -0.04, low), (half_width, 0.0, low + rng.uniform(0.4, 0.9)), rng.uniform(0.1, 0.8))
        )
    return make_parts(rows, BUILDING)


def make_door(rng: np.random.Generator, length: float, height: float) -> np.ndarray:
    """Make a wall with a door. One in three doors is open, with a room behind it."""
    x, half_width = length / 2, min(0.5, 0.45 * length)
    rows = _make_opening_parts(rng, x, half_width, DOOR_HEIGHT_M, height)
    tone = rng.uniform(0.15, 0.6)
    if rng.random() < 0.33:
        leaf = half_width if rng.random() < 0.5 else -half_width
        rows += [
            block((leaf - 0.02, 0.0, 0.0), (leaf + 0.02, 0.9, DOOR_HEIGHT_M), tone),
            *_make_room_parts(rng, x + rng.uniform(0.5, 1.5), height),
        ]
    else:
        rows += [
            block((-half_width, 0.1, 0.0), (half_width, 0.15, DOOR_HEIGHT_M), tone),
            rod((0.8 * half_width, 0.05, 1.05), (0.6 * half_width, 0.05, 1.05), 0.015, METAL),
        ]
    return make_parts(rows, BUILDING)


def make_glazing(rng: np.random.Generator, length: float, height: float) -> np.ndarray:
    """Make a wall of glass panes between posts, with a room behind it."""
    return make_parts(
        [
            *_make_pane_parts(rng, length, min(height, rng.uniform(2.3, 3.0)), height),
            *_make_room_parts(rng, length / 2, height),
        ],
        BUILDING,
    )


def make_window(rng: np.random.Generator, length: float, height: float) -> np.ndarray:
    """Make a wall of glass panes between posts, with nothing behind it."""
    return make_parts(_make_pane_parts(rng, length, height - 0.3, height), BUILDING)


def make_passage(rng: np.random.Generator, length: float, height: float) -> np.ndarray:
    """Make the opening to another corridor."""
    x, depth = length / 2, rng.uniform(6.0, 25.0)
    rows = [
        block((s * x, 0.0, FOOT_M), (s * (x + WALL_THICKNESS_M), depth, height), rng.uniform(0.4, 0.7)) for s in (-1, 1)
    ]
    rows += [
        block((-x, depth, FOOT_M), (x, depth + WALL_THICKNESS_M, height), 0.5),
        block((-x, WALL_THICKNESS_M, height), (x, depth, height + WALL_THICKNESS_M), 0.6),
    ]
    return make_parts(rows, BUILDING)


def _make_wall_panel(x: tuple, low: float, high: float, rng: np.random.Generator) -> tuple:
    return block((x[0], 0.0, low), (x[1], WALL_THICKNESS_M, high), rng.uniform(0.4, 0.75))


def _make_opening_parts(rng, x: float, half_width: float, top: float, height: float) -> list[tuple]:
    """Return the wall left of, right of and above an opening."""
    tone = rng.uniform(0.4, 0.75)
    return [
        block((-x, 0.0, FOOT_M), (-half_width, WALL_THICKNESS_M, height), tone),
        block((half_width, 0.0, FOOT_M), (x, WALL_THICKNESS_M, height), tone),
        block((-half_width, 0.0, top), (half_width, WALL_THICKNESS_M, height), tone),
    ]


def _make_room_parts(rng, x: float, height: float) -> list[tuple]:
    """Return the walls of a room behind an opening, with one piece of furniture."""
    depth, tone = rng.uniform(2.5, 6.0), rng.uniform(0.4, 0.7)
    half_width, half_depth, furniture_height = rng.uniform((0.3, 0.2, 0.7), (0.7, 0.5, 2.0))
    furniture_x = rng.uniform(-0.4, 0.4) * x
    return [
        block((-x, depth, FOOT_M), (x, depth + WALL_THICKNESS_M, height), tone),
        *(block((s * x, WALL_THICKNESS_M, FOOT_M), (s * (x - 0.1), depth, height), tone) for s in (-1, 1)),
        block((-x, WALL_THICKNESS_M, height), (x, depth, height + WALL_THICKNESS_M), tone),
        block(
            (furniture_x - half_width, depth - 2 * half_depth, 0.0),
            (furniture_x + half_width, depth, furniture_height),
            0.3,
        ),
    ]


def _make_pane_parts(rng, length: float, top: float, height: float) -> list[tuple]:
    """Return glass panes up to `top`, with a rail below them and a wall above."""
    x, count = length / 2, max(round(length / rng.uniform(1.2, 2.0)), 1)
    rows = [
        block((-x, 0.06, 0.05), (x, 0.08, top), GLASS, transmission=rng.uniform(0.6, 0.9)),
        block((-x, 0.04, 0.0), (x, 0.1, rng.uniform(0.06, 0.2)), METAL),
    ]
    rows += [
        block((post_x - 0.03, 0.02, 0.0), (post_x + 0.03, 0.12, top), METAL) for post_x in np.linspace(-x, x, count + 1)
    ]
    if top < height:
        rows.append(_make_wall_panel((-x, x), top, height, rng))
    return rows


def make_ceiling(rng: np.random.Generator, length: float, width: float, height: float) -> np.ndarray:
    """Make a ceiling centred at the origin, some with lamps or joists."""
    x, y = length / 2, width / 2
    rows = [block((-x, -y, height), (x, y, height + 0.3), rng.uniform(0.4, 0.75))]
    count, lamp_height = int(length / rng.uniform(3.0, 6.0)), rng.uniform(0.05, 0.4)
    lamp_height = min(lamp_height, height - 2.35)
    if rng.random() < 0.7:
        rows += [
            block((lamp_x - 0.15, -0.9 * y, height - lamp_height), (lamp_x + 0.15, 0.9 * y, height), 0.5)
            for lamp_x in np.linspace(-x, x, count)
        ]
    return make_parts(rows, BUILDING)


def make_column(rng: np.random.Generator, height: float) -> np.ndarray:
    """Make a round or square column."""
    half_width, tone = rng.uniform(0.12, 0.4), rng.uniform(0.3, 0.7)
    if rng.random() < 0.5:
        return make_parts([cylinder((0, 0, height / 2), (half_width, half_width, height / 2), tone)], BUILDING)
    return make_parts([block((-half_width, -half_width, FOOT_M), (half_width, half_width, height), tone)], BUILDING)


def make_shelf(rng: np.random.Generator, length: float) -> np.ndarray:
    """Make a shelf along x, open to both sides, with goods."""
    x, y, height = length / 2, rng.uniform(0.2, 0.35), rng.uniform(1.2, 2.2)
    levels = np.arange(0.1, height, rng.uniform(0.35, 0.5))
    rows = [block((s * x, -y, 0.0), (s * (x - 0.04), y, height), METAL) for s in (-1, 1)]
    for z, left, right, height_sample, depth_sample, tone in zip(levels, *rng.random((5, len(levels)))):
        rows.append(block((-x, -y, z), (x, y, z + 0.03), 0.4))
        rows.append(
            block(
                (-x + 0.6 * left * x, -(0.5 + 0.4 * depth_sample) * y, z + 0.03),
                (x - 0.6 * right * x, 0.9 * y, z + 0.1 + 0.2 * height_sample),
                0.1 + 0.5 * tone,
            )
        )
    return make_parts(rows, OTHER)


def make_table(rng: np.random.Generator, length: float, width: float) -> np.ndarray:
    """Make a table, 0.7 to 0.78 m high, with four legs or a central column, some with an object on it."""
    x, y, height = length / 2, width / 2, rng.uniform(0.7, 0.78)
    rows = [block((-x, -y, height - 0.04), (x, y, height), rng.uniform(0.2, 0.6))]
    if rng.random() < 0.6:
        rows += [
            rod((sx * 0.9 * x, sy * 0.85 * y, 0), (sx * 0.9 * x, sy * 0.85 * y, height), 0.025, METAL)
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
    else:
        rows += [rod((0, 0, 0), (0, 0, height), 0.05, METAL), block((-0.3, -0.3, 0.0), (0.3, 0.3, 0.03), METAL)]
    if rng.random() < 0.5:
        object_x = rng.uniform(-0.6, 0.6) * x
        rows.append(
            block(
                (object_x - 0.2, -0.15, height),
                (object_x + 0.2, 0.15, height + rng.uniform(0.05, 0.35)),
                rng.uniform(0.05, 0.6),
            )
        )
    return make_parts(rows, OTHER)


def make_chair(rng: np.random.Generator) -> np.ndarray:
    """Make an empty chair."""
    tone, back = rng.uniform(0.1, 0.5), rng.uniform(0.8, 0.95)
    rows = [block((-0.2, -0.21, 0.42), (0.22, 0.21, 0.46), tone), block((-0.22, -0.2, 0.5), (-0.19, 0.2, back), tone)]
    if rng.random() < 0.7:
        rows += [
            rod((sx * 0.19, sy * 0.18, 0), (sx * 0.19, sy * 0.18, 0.44), 0.015, METAL)
            for sx in (-1, 1)
            for sy in (-1, 1)
        ]
    else:  # office chair on castors
        rows += [
            rod((0, 0, 0.06), (0, 0, 0.44), 0.03, METAL),
            cylinder((0, 0, 0.06), (0.28, 0.28, 0.03), RUBBER, transmission=0.5),
        ]
    return make_parts(rows, OTHER)


def make_counter(rng: np.random.Generator) -> np.ndarray:
    """Make a service counter."""
    y, height = rng.uniform(1.0, 2.5), rng.uniform(0.95, 1.2)
    return make_parts(
        [
            block((-0.35, -y, 0.0), (0.3, y, height), rng.uniform(0.2, 0.6)),
            block((-0.4, -y - 0.05, height), (0.4, y + 0.05, height + 0.05), 0.4),
        ],
        OTHER,
    )


def make_display(rng: np.random.Generator) -> np.ndarray:
    """Make a display board on a stand, as large as a person."""
    y, low, height = rng.uniform((0.2, 0.1, 1.5), (0.5, 0.9, 2.0))
    return make_parts(
        [
            block((-0.03, -y, low), (0.03, y, height), rng.uniform(0.1, 0.7)),
            rod((0, 0, 0), (0, 0, height), 0.025, METAL),
            block((-0.25, -0.8 * y, 0.0), (0.25, 0.8 * y, 0.03), METAL),
        ],
        OTHER,
    )


def make_machine(rng: np.random.Generator) -> np.ndarray:
    """Make a vending machine, wardrobe or locker."""
    x, y, height = rng.uniform((0.2, 0.25, 1.4), (0.45, 0.6, 2.0))
    return make_parts(
        [
            block((-x, -y, 0.0), (x, y, height), rng.uniform(0.1, 0.6)),
            block((x, -0.8 * y, 0.7), (x + 0.01, 0.4 * y, height - 0.15), GLASS),
        ],
        OTHER,
    )


def make_boxes(rng: np.random.Generator) -> np.ndarray:
    """Make a pile of two to four boxes."""
    rows, z = [], 0.0
    for x, y, height_sample, yaw_sample, tone in rng.random((rng.integers(2, 5), 5)).tolist():
        half_size, box_height = (0.15 + 0.15 * x, 0.15 + 0.15 * y), 0.2 + 0.3 * height_sample
        rows.append(
            block(
                (-half_size[0], -half_size[1], z),
                (half_size[0], half_size[1], z + box_height),
                0.2 + 0.4 * tone,
                yaw=0.5 * (yaw_sample - 0.5),
            )
        )
        z += box_height
    return make_parts(rows, OTHER)


def make_coat_stand(rng: np.random.Generator) -> np.ndarray:
    """Make a coat stand with coats."""
    height, radius, low = rng.uniform((1.6, 0.12, 0.5), (1.85, 0.25, 1.1))
    return make_parts(
        [
            rod((0, 0, 0), (0, 0, height), 0.025, METAL),
            cylinder((0, 0, 0.02), (0.22, 0.22, 0.02), METAL),
            cylinder(
                (0, 0, (low + height) / 2 - 0.1), (radius, 0.8 * radius, (height - low) / 2), rng.uniform(0.1, 0.5)
            ),
        ],
        OTHER,
    )


def make_cart(rng: np.random.Generator) -> np.ndarray:
    """Make a cart for cleaning, mail or trays."""
    x, y, height = rng.uniform((0.3, 0.22, 0.8), (0.5, 0.3, 1.5))
    rows = [block((-x, -y, z), (x, y, z + 0.04), METAL) for z in np.linspace(0.2, height, 3)]
    rows += [rod((sx * x, sy * y, 0.1), (sx * x, sy * y, height), 0.02, METAL) for sx in (-1, 1) for sy in (-1, 1)]
    rows += [disc((sx * 0.8 * x, 0, 0.06), 0.06, y, RUBBER, transmission=0.7) for sx in (-1, 1)]
    rows.append(block((-0.8 * x, -0.8 * y, 0.24), (0.2 * x, 0.8 * y, 0.7 * height), rng.uniform(0.1, 0.6)))
    return make_parts(rows, OTHER)


# Functions that make objects which a detector may confuse with a person.
PERSON_SIZED = (make_display, make_machine, make_boxes, make_coat_stand, make_cart, make_chair)
