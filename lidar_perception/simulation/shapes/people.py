"""Pedestrians who walk or stand, the things they carry, and people who sit or use a wheelchair."""

from __future__ import annotations

from functools import partial
from math import cos, hypot, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from lidar_perception.classes import CLASSES, PEDESTRIAN
from lidar_perception.simulation.shapes.thing import METAL, RUBBER, SKIN, Thing, block, disc, draw_size, make_rigid, rod
from lidar_perception.simulation.solids import BOX, ELLIPSOID, compute_hull, part, parts

PERSON, OTHER = 30, 99
CARRIED = ("", "backpack", "bag", "umbrella", "trolley", "pram")
WHEEL_TRANSMISSION = 0.6  # fraction of beams that pass between the spokes of a wheelchair

STANCE = 0.54  # fraction of a stride with the foot on the ground; real walkers: 0.6
MIN_LENGTH_SHARE = 0.3  # minimum length of a box in KITTI, as a fraction of the height
HEEL_OFF = 0.6  # fraction of the stance after which the heel rises
# Lengths as fractions of the height, after Drillis and Contini (1966); radii include clothes.
THIGH, SHANK, ANKLE, FOOT, SHOULDER, UPPER_ARM, FOREARM = (0.245, 0.246, 0.039, 0.152, 0.818, 0.186, 0.2)
REACH = 0.99 * (THIGH + SHANK)
HIP = REACH + ANKLE


class PersonBuild(NamedTuple):
    """A person.

    Attributes:
        height, width: Metres.
        step: Distance between footfalls in m, 0 for a standing person.
        phase: Share of a stride at the start.
        hair, coat, trousers: Reflectances.
        carried: One of CARRIED.
        shift: Distance of the hips ahead of the origin, m.
    """

    height: float
    width: float
    step: float
    phase: float
    hair: float
    coat: float
    trousers: float
    carried: str = ""
    shift: float = 0.0


def make_pedestrian(rng: np.random.Generator, speed: float, child: bool = False, carried: str = "") -> Thing:
    """Make a person who walks at speed (m/s), or stands.

    The length of the box covers the body over a whole stride, without a bag, umbrella, trolley or
    pram, and is at least MIN_LENGTH_SHARE of the height. Steps grow with the root of the speed
    (Sekiya et al. 1996: length over rate is 0.0065 m min for all speeds).
    """
    _, width, height = draw_size(rng, CLASSES[PEDESTRIAN])
    if child:
        shrink = rng.uniform(0.62, 0.8)
        width, height = width * max(shrink, 0.7), height * shrink
    step = min(sqrt(60 * 0.0065 * abs(speed)) * height / 1.72, 0.5 * height)
    build = PersonBuild(
        height,
        max(width, 0.27 * height),
        step,
        rng.uniform(),
        rng.uniform(0.03, 0.3),
        rng.uniform(0.2, 0.85),
        rng.uniform(0.15, 0.75),
        carried,
    )
    low, high = _measure_stride(build)
    build = build._replace(shift=-(low + high) / 2)
    size = (max(high - low, MIN_LENGTH_SHARE * height), build.width, height)
    return Thing(partial(pose_walker, build=build), size, CLASSES[PEDESTRIAN])


def _measure_stride(build: PersonBuild) -> tuple[float, float]:
    """Return the smallest and largest x over a stride, whose halves are symmetric."""
    body = build._replace(carried="backpack" if build.carried == "backpack" else "", phase=0.0)
    poses = [_limb_parts(i / 24, body) for i in range(12 if build.step else 1)]
    rows = [row for limbs, _ in poses for row in limbs] + _trunk_parts(body, 0.0)
    low, _, _, high, _, _ = compute_hull(parts(rows, PERSON))
    return low, high


def pose_walker(travelled: float, build: PersonBuild) -> np.ndarray:
    """Return the parts (P,) PART of a walker after a distance in m.

    The last two rows before the load are the feet, right and left. A foot on the ground does not
    move, and the hips sink as the legs spread, so that the height is that of the box when a leg is
    upright below the hips.
    """
    turns = build.phase + (travelled / (2 * build.step) if build.step else 0.0)
    limbs, up = _limb_parts(turns, build)
    trunk = _trunk_parts(build, up)
    made = parts(trunk[:5] + limbs + trunk[5:], PERSON)
    made["centre"][:, 0] += build.shift
    return made


def _trunk_parts(build: PersonBuild, up: float) -> list[tuple]:
    """Return head, neck, chest, hips and load, raised by `up` metres."""
    h, w = build.height, build.width
    return [
        part(ELLIPSOID, (0.012 * h, 0, 0.93 * h + up), (0.055 * h, 0.045 * h, 0.068 * h), reflectance=SKIN),
        part(ELLIPSOID, (-0.012 * h, 0, 0.948 * h + up), (0.05 * h, 0.047 * h, 0.052 * h), reflectance=build.hair),
        rod((0, 0, 0.8 * h + up), (0.005 * h, 0, 0.89 * h + up), 0.032 * h, reflectance=SKIN),
        part(ELLIPSOID, (0, 0, 0.70 * h + up), (0.08 * h, min(0.125 * h, 0.42 * w), 0.15 * h), reflectance=build.coat),
        part(
            ELLIPSOID,
            (0, 0, 0.54 * h + up),
            (0.075 * h, min(0.105 * h, 0.38 * w), 0.11 * h),
            reflectance=build.trousers,
        ),
        *_load_parts(build.carried, h, w, up, build.coat),
    ]


def _limb_parts(turns: float, build: PersonBuild) -> tuple[list[tuple], float]:
    """Return arms, legs and feet after a number of strides, and the rise of the hips in m."""
    h = build.height
    feet = [_pose_foot((turns + half) % 1.0, 2 * build.step, h) for half in (0.0, 0.5)]
    hip = min(
        HIP * h, *(z + sqrt((REACH * h) ** 2 - min(0.88 * abs(x), 0.9 * REACH * h) ** 2) for _, _, (x, z) in feet)
    )
    up, rows = hip - HIP * h, []
    for side, (u, left) in zip((-1, 1), ((turns + 0.5, False), (turns, True))):
        rows += _arm_parts(side, u, build, up, left)
    for side, (_, _, ankle) in zip((-1, 1), feet):
        rows += _leg_parts(side, ankle, hip, h, build.trousers)
    for side, (toe, tilt, _) in zip((-1, 1), feet):
        flat, steep, half = cos(tilt), sin(tilt), FOOT * h / 2
        rows.append(
            part(
                BOX,
                (toe[0] - half * flat + 0.02 * h * steep, side * 0.055 * h, toe[1] + half * steep + 0.02 * h * flat),
                (half, 0.03 * h, 0.02 * h),
                pitch=tilt,
                reflectance=RUBBER,
            )
        )
    return rows, up


def _pose_foot(u: float, stride: float, h: float) -> tuple[tuple, float, tuple]:
    """Return tip of the sole (x, z), tilt of the foot (heel up) and ankle (x, z) at share u.

    Positions are in m from the hips and the ground. The foot stands from u = 0 to STANCE.
    """
    most = 0.6 * min(stride / (0.8 * h), 1.0)
    if u < STANCE:
        x = (STANCE / 2 - u) * stride
        lift, rise = 0.0, max(u / STANCE - HEEL_OFF, 0.0) / (1 - HEEL_OFF)
    else:
        v = (u - STANCE) / (1 - STANCE)
        smooth = v * v * (3 - 2 * v)
        x = stride * (STANCE * (smooth - 0.5))
        lift, rise = 0.03 * stride * sin(pi * v), 1.0 - smooth
    tilt = most * rise
    ahead = 0.7 * FOOT * h  # distance from the ankle to the tip of the foot
    flat, steep = cos(tilt), sin(tilt)
    toe = (x + ahead, lift)
    ankle = (toe[0] - ahead * flat + ANKLE * h * steep, lift + ahead * steep + ANKLE * h * flat)
    return toe, tilt, ankle


def _leg_parts(side: int, ankle: tuple, hip: float, h: float, trousers: float) -> list[tuple]:
    """Return thigh and shank. The knee bends forward; the pelvis turns with the legs."""
    start = (0.12 * ankle[0], hip)
    x, z = find_knee(start, ankle, THIGH * h, SHANK * h)
    y = side * 0.055 * h
    return [
        rod((start[0], y, hip), (x, y, z), 0.05 * h, reflectance=trousers),
        rod((x, y, z), (ankle[0], y, ankle[1]), 0.037 * h, reflectance=trousers),
    ]


def find_knee(hip: tuple, ankle: tuple, thigh: float, shank: float) -> tuple[float, float]:
    """Return the position of the knee (x, z) between a hip and an ankle (x, z)."""
    x, z = ankle[0] - hip[0], ankle[1] - hip[1]
    far = hypot(x, z)
    x, z = x / far, z / far
    far = min(far, 0.9999 * (thigh + shank))
    along = (thigh**2 - shank**2 + far**2) / (2 * far)
    bend = sqrt(max(thigh**2 - along**2, 0.0))
    return hip[0] + along * x - bend * z, hip[1] + along * z + bend * x


def _arm_parts(side: int, u: float, build: PersonBuild, up: float, left: bool) -> list[tuple]:
    """Return upper arm and forearm, which swing with the other leg or hold the load.

    The forearm is at the width of the box.
    """
    h, w, coat = build.height, build.width, build.coat
    swing = 0.45 * min(build.step / (0.43 * h), 1.2) * cos(2 * pi * u)
    bend = 0.3 if build.step else build.phase  # standing people bend their arms by a random amount
    if build.carried == "pram" or (build.carried == "umbrella" and left):
        swing, bend = 0.2, (1.1 if build.carried == "pram" else 2.2)
    elif build.carried == "trolley" and not left:
        swing, bend = -0.45, 0.0
    radius = 0.03 * h
    y = side * (w / 2 - radius)
    shoulder = (0.0, side * min(0.115 * h, w / 2 - 2 * radius), SHOULDER * h + up)
    elbow = (UPPER_ARM * h * sin(swing), y, shoulder[2] - UPPER_ARM * h * cos(swing))
    hand = (elbow[0] + FOREARM * h * sin(swing + bend), y, elbow[2] - FOREARM * h * cos(swing + bend))
    return [rod(shoulder, elbow, radius, reflectance=coat), rod(elbow, hand, radius, reflectance=coat)]


def _load_parts(carried: str, h: float, w: float, up: float, coat: float) -> list[tuple]:
    """Return the load that is carried, pulled or pushed; bag and trolley are on the right."""
    if carried == "backpack":
        return [part(ELLIPSOID, (-0.1 * h, 0, 0.7 * h + up), (0.07 * h, 0.085 * h, 0.13 * h), reflectance=0.5 * coat)]
    if carried == "bag":
        return [
            block(
                (-0.15, -w / 2 - 0.05, 0.28 * h),
                (0.15, -w / 2 + 0.05, 0.28 * h + 0.3),
                reflectance=0.35,
                semantic=OTHER,
            )
        ]
    if carried == "umbrella":
        top = h + 0.25
        return [
            part(ELLIPSOID, (0.08, 0, top - 0.11), (0.5, 0.5, 0.11), reflectance=coat),
            rod((0.1, w / 2 - 0.06, 0.7 * h), (0.08, 0.02, top - 0.1), 0.01, reflectance=METAL),
        ]
    if carried == "trolley":
        y = -w / 2 + 0.03
        return [
            block((-0.85, y - 0.18, 0.05), (-0.6, y + 0.18, 0.6), reflectance=0.25, semantic=OTHER),
            rod((-0.6, y, 0.6), (-0.25, y, 0.47 * h), 0.015, reflectance=METAL, semantic=OTHER),
            disc((-0.72, y, 0.05), 0.05, 0.18, reflectance=RUBBER, semantic=OTHER),
        ]
    if carried == "pram":
        return [
            part(ELLIPSOID, (0.85, 0, 0.72), (0.42, 0.22, 0.2), reflectance=0.3, semantic=OTHER),
            part(ELLIPSOID, (0.66, 0, 0.88), (0.25, 0.23, 0.2), reflectance=0.25, semantic=OTHER),
            rod((0.25, 0, 0.6 * h), (1.1, 0, 0.3), 0.02, reflectance=METAL, semantic=OTHER),
            disc((0.55, 0, 0.14), 0.14, 0.27, reflectance=RUBBER, transmission=0.6, semantic=OTHER),
            disc((1.15, 0, 0.12), 0.12, 0.25, reflectance=RUBBER, transmission=0.6, semantic=OTHER),
        ]
    return []


def make_sitting_person(rng: np.random.Generator, chair: bool = True) -> Thing:
    """Make a sitting person with knees and feet ahead; the box includes the chair.

    Without a chair they need a bench with a seat at 0.45 m.
    """
    length, width, height = size = draw_size(rng, "Person_sitting")
    coat, trousers = rng.uniform(0.2, 0.85), rng.uniform(0.15, 0.75)
    front, back, seat = length / 2, -length / 2, 0.45
    hip, trunk = back + 0.22, height - seat
    knees, radius = front - 0.18, 0.05
    rows = [
        part(ELLIPSOID, (hip + 0.04, 0, height - 0.115), (0.095, 0.08, 0.115), reflectance=SKIN),
        part(ELLIPSOID, (hip, 0, seat + 0.42 * trunk), (0.13, min(0.2, 0.36 * width), 0.38 * trunk), reflectance=coat),
        part(ELLIPSOID, (hip, 0, seat + 0.1), (0.15, min(0.18, 0.36 * width), 0.11), reflectance=trousers),
    ]
    for side in (-1, 1):
        y = side * 0.1
        rows += [
            rod((hip, y, seat + 0.09), (knees, y, seat + 0.07), 0.075, reflectance=trousers),
            rod((knees, y, seat + 0.07), (knees, y, 0.07), 0.055, reflectance=trousers),
            block((front - 0.26, y - 0.05, 0.0), (front, y + 0.05, 0.08), reflectance=RUBBER),
        ]
        y = side * (width / 2 - radius)
        elbow, hand = (hip, y, seat + 0.32 * trunk), (knees - 0.05, y, seat + 0.2)
        rows += [
            rod((hip, side * 0.3 * width, seat + 0.68 * trunk), elbow, radius, reflectance=coat),
            rod(elbow, hand, radius, reflectance=coat),
        ]
    if chair:
        rows += [
            block((back + 0.03, -0.22, seat - 0.04), (hip + 0.28, 0.22, seat), reflectance=METAL, semantic=OTHER),
            block((back, -0.22, seat), (back + 0.03, 0.22, seat + 0.42), reflectance=METAL, semantic=OTHER),
        ]
        rows += [
            rod((x, 0.0, 0.0), (x, 0.0, seat), 0.02, reflectance=METAL, semantic=OTHER)
            for x in (back + 0.05, hip + 0.25)
        ]
    else:
        rows.append(part(ELLIPSOID, (back + 0.1, 0, seat + 0.45 * trunk), (0.1, 0.1, 0.2), reflectance=coat))
    return make_rigid(parts(rows, PERSON), size, "Person_sitting")


def make_wheelchair(rng: np.random.Generator) -> Thing:
    """Make a person in a wheelchair: a Person_sitting whose box includes the chair."""
    person = make_sitting_person(rng, chair=False)
    (length, width, height), radius = person.size, rng.uniform(0.28, 0.32)
    y, back = width / 2 - 0.03, -length / 2 + 0.3
    wheels = [
        disc((back, s * y, radius), radius, 0.02, reflectance=RUBBER, transmission=WHEEL_TRANSMISSION) for s in (-1, 1)
    ]
    wheels += [disc((length / 2 - 0.15, s * 0.8 * y, 0.1), 0.1, 0.02, reflectance=RUBBER) for s in (-1, 1)]
    seat = [
        block((back - 0.2, -0.9 * y, 0.4), (back + 0.25, 0.9 * y, 0.44), reflectance=METAL),
        block((back - 0.25, -0.9 * y, 0.44), (back - 0.2, 0.9 * y, 0.9), reflectance=METAL),
    ]
    made = np.concatenate([person.parts(0.0), parts(wheels + seat, OTHER)])
    return make_rigid(made, (length, width, height), person.label)
