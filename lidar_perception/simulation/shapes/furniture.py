"""Street furniture, much of it as large as a person.

Each function returns (P,) PART with the front facing +x. Fixed objects extend below the ground.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.simulation.shapes.primitives import (
    GLASS,
    METAL,
    PLATE,
    RUBBER,
    block,
    cylinder,
    disc,
    ellipsoid,
    rod,
)
from lidar_perception.simulation.solids import make_parts

BUILDING, FENCE, VEGETATION, POLE, SIGN, OTHER = 50, 51, 70, 80, 81, 99
FOOT_M = -0.3  # z of the bottom of fixed objects


def make_pole(rng: np.random.Generator) -> np.ndarray:
    """Make a bare mast of 2.5 to 8 m."""
    return make_parts([_make_post(rng.uniform(2.5, 8.0), rng.uniform(0.04, 0.12))], POLE)


def make_post(rng: np.random.Generator) -> np.ndarray:
    """Make a thin post of 1.1 to 2.2 m, as used at parking spaces and gates; some carry a small box or sign."""
    height, radius = rng.uniform((1.1, 0.025), (2.2, 0.08))
    rows = [_make_post(height, radius)]
    if rng.random() < 0.5:
        low, half_width = rng.uniform((0.5 * height, 0.06), (height - 0.3, 0.18))
        rows.append(block((radius, -half_width, low), (radius + 0.1, half_width, low + 0.3), rng.uniform(0.1, 0.5)))
    return make_parts(rows, POLE)


def make_lamp(rng: np.random.Generator) -> np.ndarray:
    """Make a street lamp of 4 to 8 m: mast, base with a door, arm to +x, head."""
    height, arm = rng.uniform(4.0, 8.0), rng.uniform(0.4, 1.5)
    return make_parts(
        [
            _make_post(height, 0.06),
            _make_post(1.1, 0.09),
            rod((0, 0, height), (arm, 0, height + 0.1), 0.03, METAL),
            ellipsoid((arm + 0.25, 0, height + 0.08), (0.35, 0.14, 0.08), METAL),
        ],
        POLE,
    )


def make_traffic_light(rng: np.random.Generator) -> np.ndarray:
    """Make a mast with lights at 2.2 m, a push button, and up to two signs."""
    height, child_rng = rng.uniform(3.0, 3.5), rng.spawn(1)[0]
    rows = [
        _make_post(height, 0.07),
        block((0.08, -0.15, height - 0.95), (0.3, 0.15, height), 0.05),
        block((0.06, -0.28, height - 1.0), (0.08, 0.28, height + 0.05), 0.1),
        block((-0.16, -0.06, 1.0), (-0.06, 0.06, 1.25), 0.4),
    ]
    return make_parts(
        rows + [_make_plate(0.1, *child_rng.uniform((0.5, 0.2), (1.6, 0.35))) for _ in range(child_rng.integers(3))],
        POLE,
    )


def make_sign(rng: np.random.Generator) -> np.ndarray:
    """Make a post with one or two retroreflective plates.

    Some plates are low, as on traffic islands, and half of these are on a mast. In KITTI, 15 % of
    the clusters as wide as a person are partly retroreflective, most of them close to the ground.
    """
    plate_bottom = rng.uniform(1.7, 2.2) if rng.random() < 0.6 else rng.uniform(0.4, 1.0)
    size, child_rng = rng.uniform(0.25, 0.4), rng.spawn(1)[0]
    plates = [(plate_bottom, size)] + ([(plate_bottom + 2 * size + 0.05, 0.2)] if rng.random() < 0.4 else [])
    has_mast = plate_bottom < 1.0 and child_rng.random() < 0.5
    rows = [_make_post(child_rng.uniform(2.5, 4.0), 0.07) if has_mast else _make_post(plate_bottom + 2 * size, 0.035)]
    return make_parts(rows + [_make_plate(0.08 if has_mast else 0.04, z, half_width) for z, half_width in plates], POLE)


def _make_plate(x: float, z: float, half_width: float) -> tuple:
    """Return a square plate at x with its lower edge at z."""
    return block((x, -half_width, z), (x + 0.02, half_width, z + 2 * half_width), PLATE, semantic=SIGN)


def make_fence(rng: np.random.Generator, length: float) -> np.ndarray:
    """Make a fence, centred along x: posts, two rails, and bars or boards with gaps.

    Bars and boards are a block with a density, so that grazing beams hit them more often.
    """
    height, x = rng.uniform(0.8, 1.9), length / 2
    rows = [rod((post_x, 0, -0.5), (post_x, 0, height), 0.04, METAL) for post_x in np.linspace(0.04 - x, x - 0.04, 5)]
    rows += [
        block((-x, -0.02, fraction * height), (x, 0.02, fraction * height + 0.05), METAL) for fraction in (0.15, 0.9)
    ]
    rows.append(
        block((-x, -0.012, 0.05), (x, 0.012, 0.98 * height), 0.3, density=rng.choice((12.0, 25.0, 80.0)))
    )  # 0.75, 0.55 or 0.15 of the beams pass at normal incidence
    return make_parts(rows, FENCE)


def make_wall(rng: np.random.Generator, length: float) -> np.ndarray:
    """Make a garden wall, centred along x, with a coping and piers at its ends."""
    height, x, tone = rng.uniform(0.5, 2.2), length / 2, rng.uniform(0.3, 0.5)
    rows = [
        block((-x, -0.12, -0.6), (x, 0.12, height), tone),
        block((-x, -0.16, height), (x, 0.16, height + 0.06), 0.4),
    ]
    rows += [block((s * x, -0.2, -0.6), (s * (x - 0.4), 0.2, height + 0.2), tone) for s in (-1, 1)]
    return make_parts(rows, FENCE)


def make_litter_bin(rng: np.random.Generator) -> np.ndarray:
    """Make a round litter bin, standing or on a post."""
    grey = rng.uniform(0.1, 0.5)
    if rng.random() < 0.5:
        height, radius = rng.uniform(0.7, 1.2), rng.uniform(0.2, 0.35)
        return make_parts(
            [
                _make_upright_cylinder(0.0, height, radius, grey),
                ellipsoid((0, 0, height), (radius, radius, 0.15), grey),
            ],
            OTHER,
        )
    return make_parts([_make_post(1.15, 0.03), cylinder((0.22, 0, 0.8), (0.19, 0.19, 0.28), grey)], OTHER)


def make_wheelie_bin(rng: np.random.Generator) -> np.ndarray:
    """Make a bin on wheels, of 120 l or 1100 l."""
    half_sizes, height = ((0.25, 0.24), 0.93) if rng.random() < 0.75 else ((0.55, 0.65), 1.3)
    x, y = half_sizes
    return make_parts(
        [
            block((-x, -0.9 * y, 0.1), (x, 0.9 * y, height), rng.uniform(0.1, 0.4)),
            block((-x - 0.05, -y, height), (x + 0.04, y, height + 0.08), 0.2),
            disc((0.1 - x, 0, 0.1), 0.1, y, RUBBER),
        ],
        OTHER,
    )


def make_bollard(rng: np.random.Generator) -> np.ndarray:
    """Make a bollard of 0.6 to 1.1 m, some with a retroreflective band."""
    height, radius = rng.uniform(0.6, 1.1), rng.uniform(0.05, 0.14)
    rows = [
        _make_upright_cylinder(FOOT_M, height, radius, rng.uniform(0.1, 0.5)),
        ellipsoid((0, 0, height), (radius, radius, 0.06), 0.3),
    ]
    if rng.random() < 0.3:
        rows.append(_make_upright_cylinder(height - 0.2, height - 0.1, radius + 0.003, PLATE))
    return make_parts(rows, POLE)


def make_beacon(rng: np.random.Generator) -> np.ndarray:
    """Make a retroreflective post or board of 0.8 to 1.6 m, as on traffic islands and at roadworks.

    It is about as high as a person, but narrower. Some have a base or a round sign.
    """
    height, low, half_width = rng.uniform((0.8, 0.05, 0.06), (1.6, 0.4, 0.3))
    if rng.random() < 0.5:
        rows = [
            _make_upright_cylinder(FOOT_M, low, 0.8 * half_width, 0.3),
            _make_upright_cylinder(low, height, half_width, PLATE),
        ]
    else:
        rows = [_make_post(low, 0.04), block((-0.03, -half_width, low), (0.03, half_width, height), PLATE)]
    if rng.random() < 0.4:
        rows.append(block((-0.4, -0.2, 0.0), (0.4, 0.2, 0.1), RUBBER))
    if rng.random() < 0.3:
        rows += [_make_post(height + 0.5, 0.04), ellipsoid((0, 0, height + 0.3), (0.03, 0.3, 0.3), PLATE)]
    return make_parts(rows, SIGN)


def make_cabinet(rng: np.random.Generator) -> np.ndarray:
    """Make a telephone or power cabinet of 0.8 to 1.7 m."""
    x, y, height = rng.uniform((0.15, 0.2, 0.8), (0.3, 0.8, 1.7))
    return make_parts(
        [
            block((-x, -y, FOOT_M), (x, y, height), rng.uniform(0.2, 0.5)),
            block((-x - 0.03, -y - 0.03, height), (x + 0.03, y + 0.03, height + 0.05), 0.35),
        ],
        OTHER,
    )


def make_bench(rng: np.random.Generator) -> np.ndarray:
    """Make a bench with a backrest and a seat at 0.45 m."""
    y = rng.uniform(0.7, 1.0)
    wood = rng.uniform(0.2, 0.4)
    rows = [
        block((-0.22, -y, 0.41), (0.25, y, 0.45), wood, transmission=0.2),
        block((-0.29, -y, 0.55), (-0.25, y, 0.85), wood, transmission=0.2),
    ]
    rows += [block((-0.27, s * y * 0.75, FOOT_M), (-0.2, s * (y * 0.75 - 0.06), 0.85), wood) for s in (-1, 1)]
    rows += [block((0.15, s * y * 0.75, FOOT_M), (0.22, s * (y * 0.75 - 0.06), 0.42), wood) for s in (-1, 1)]
    return make_parts(rows, OTHER)


def make_shopping_trolley(rng: np.random.Generator) -> np.ndarray:
    """Make a shopping trolley with a wire basket."""
    rows = [
        block((-0.4, -0.28, 0.55), (0.45, 0.28, 1.0), METAL, density=rng.uniform(0.7, 1.2)),
        rod((-0.5, -0.27, 1.05), (-0.5, 0.27, 1.05), 0.02, 0.2),
        block((-0.4, -0.25, 0.15), (0.45, 0.25, 0.25), METAL, transmission=0.6),
    ]
    rows += [rod((-0.35, s * 0.25, 0.1), (-0.45, s * 0.25, 1.0), 0.02, METAL) for s in (-1, 1)]
    rows += [disc((x, 0.0, 0.06), 0.06, 0.27, RUBBER, transmission=0.7) for x in (-0.35, 0.4)]
    return make_parts(rows, OTHER)


def make_phone_box(rng: np.random.Generator) -> np.ndarray:
    """Make a phone box: four posts, panes, a roof and the telephone."""
    half_width, height = 0.45, rng.uniform(2.2, 2.4)
    rows = [
        rod((sx * half_width, sy * half_width, FOOT_M), (sx * half_width, sy * half_width, height), 0.04, METAL)
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    rows += [
        block(
            (-half_width, s * half_width, 0.3), (half_width, s * (half_width - 0.01), height), GLASS, transmission=0.7
        )
        for s in (-1, 1)
    ]
    rows += [
        block(
            (-half_width - 0.05, -half_width - 0.05, height), (half_width + 0.05, half_width + 0.05, height + 0.15), 0.3
        ),
        block((-half_width, -half_width + 0.05, FOOT_M), (-half_width + 0.25, half_width - 0.05, 1.7), 0.3),
    ]
    return make_parts(rows, OTHER)


def make_advertising_column(rng: np.random.Generator) -> np.ndarray:
    """Make a round advertising column of 2.5 to 3.6 m."""
    height, radius = rng.uniform(2.5, 3.6), rng.uniform(0.5, 0.7)
    return make_parts(
        [
            _make_upright_cylinder(FOOT_M, height, radius, rng.uniform(0.3, 0.5)),
            _make_upright_cylinder(height, height + 0.15, radius + 0.08, 0.3),
            ellipsoid((0, 0, height + 0.15), (radius, radius, 0.25), 0.3),
        ],
        OTHER,
    )


def make_cone(rng: np.random.Generator) -> np.ndarray:
    """Make a traffic cone of 0.5 to 0.75 m with a retroreflective band."""
    height = rng.uniform(0.5, 0.75)
    return make_parts(
        [
            block((-0.19, -0.19, 0), (0.19, 0.19, 0.03), 0.3),
            _make_upright_cylinder(0.03, 0.4 * height, 0.13, 0.4),
            _make_upright_cylinder(0.4 * height, 0.7 * height, 0.09, PLATE),
            _make_upright_cylinder(0.7 * height, height, 0.05, 0.4),
        ],
        OTHER,
    )


def make_planter(rng: np.random.Generator) -> np.ndarray:
    """Make a tub with a plant, as high as a person."""
    height = rng.uniform(0.35, 0.6)
    plant_height = rng.uniform(0.35, 0.65)
    return make_parts(
        [
            _make_upright_cylinder(0.0, height, 0.32, rng.uniform(0.25, 0.45)),
            ellipsoid(
                (0, 0, height + 0.9 * plant_height),
                (0.3, 0.28, plant_height),
                0.34,
                semantic=VEGETATION,
                density=rng.uniform(2, 6),
            ),
        ],
        OTHER,
    )


def make_parasol(rng: np.random.Generator) -> np.ndarray:
    """Make a cafe table with two chairs under a parasol."""
    height = rng.uniform(2.1, 2.5)
    rows = [
        rod((0, 0, 0), (0, 0, height), 0.025, METAL),
        ellipsoid((0, 0, height), (1.3, 1.3, 0.2), 0.35),
        _make_upright_cylinder(0.7, 0.74, 0.4, 0.35),
    ]
    for s in (-1, 1):
        rows += [
            block((s * 0.55, -0.2, 0.0), (s * 0.95, 0.2, 0.45), 0.25, transmission=0.6),
            block((s * 0.92, -0.2, 0.45), (s * 0.95, 0.2, 0.9), 0.25, transmission=0.3),
        ]
    return make_parts(rows, OTHER)


def make_hydrant(rng: np.random.Generator) -> np.ndarray:
    """Make a pump, hydrant or parking meter: a post with a thicker head."""
    height = rng.uniform(0.9, 1.5)
    return make_parts(
        [
            _make_upright_cylinder(FOOT_M, height, rng.uniform(0.04, 0.12), 0.3),
            ellipsoid((0, 0, height - 0.15), (0.14, 0.17, 0.22), rng.uniform(0.1, 0.4)),
        ],
        OTHER,
    )


def make_stairs(rng: np.random.Generator, length: float) -> np.ndarray:
    """Make stairs, centred along x, that rise from y = 0 towards +y, with a landing and handrails."""
    x, count, rise = length / 2, int(rng.integers(2, 7)), rng.uniform(0.12, 0.17)
    end = 0.3 * count + rng.uniform(0.5, 2.0)
    rows = [block((-x, 0.3 * i, FOOT_M), (x, end, rise * (i + 1)), 0.4) for i in range(count)]
    for post_x in np.linspace(-x + 0.05, x - 0.05, max(2, int(length / 4) + 1)):
        top = (post_x, 0.3 * count, rise * count + 0.9)
        rows += [
            rod((post_x, 0.0, 0.9), top, 0.025, METAL),
            rod((post_x, 0.05, 0.0), (post_x, 0.05, 0.9), 0.02, METAL),
            rod((post_x, 0.3 * count, 0.0), top, 0.02, METAL),
        ]
    return make_parts(rows, BUILDING)


def make_bicycle_stand(rng: np.random.Generator) -> np.ndarray:
    """Make a hoop for locking bicycles."""
    height = rng.uniform(0.7, 0.9)
    rows = [rod((s * 0.35, 0, FOOT_M), (s * 0.35, 0, height), 0.025, METAL) for s in (-1, 1)]
    return make_parts([*rows, rod((-0.35, 0, height), (0.35, 0, height), 0.025, METAL)], POLE)


def _make_post(height: float, radius: float) -> tuple:
    return _make_upright_cylinder(FOOT_M, height, radius, METAL)


def _make_upright_cylinder(low: float, height: float, radius: float, reflectance: float) -> tuple:
    return cylinder((0, 0, (low + height) / 2), (radius, radius, (height - low) / 2), reflectance)


# Functions that make objects which a detector may confuse with a person.
PERSON_SIZED = (
    make_post,
    make_post,
    make_sign,
    make_beacon,
    make_litter_bin,
    make_wheelie_bin,
    make_bollard,
    make_cabinet,
    make_shopping_trolley,
    make_phone_box,
    make_advertising_column,
    make_cone,
    make_planter,
    make_parasol,
    make_hydrant,
    make_traffic_light,
    make_bench,
)
