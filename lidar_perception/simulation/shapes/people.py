"""People who walk, stand, sit or use a wheelchair, and the objects they carry."""

from __future__ import annotations

from functools import partial
from math import cos, hypot, pi, sin, sqrt, tan
from typing import NamedTuple

import numpy as np

from lidar_perception.classes import CLASSES, PEDESTRIAN
from lidar_perception.simulation.shapes.primitives import METAL, RUBBER, SKIN, block, box, disc, ellipsoid, rod
from lidar_perception.simulation.shapes.scene_object import SceneObject, draw_size, make_rigid
from lidar_perception.simulation.solids import CYLINDER, ELLIPSOID, compute_hull, make_parts

PERSON, OTHER = 30, 99
CARRIED = ("", "backpack", "bag", "umbrella", "trolley", "pram")
WHEEL_TRANSMISSION = 0.6  # fraction of beams that pass between the spokes of a wheelchair

STANCE = 0.54  # fraction of a stride with the foot on the ground; 0.6 in humans
MIN_LENGTH_RATIO = 0.3  # minimum ratio of length and height of a box, as in KITTI
HEEL_OFF = 0.6  # fraction of the stance at which the heel begins to rise
# Lengths as fractions of the height (Drillis and Contini 1966).
THIGH, SHANK, ANKLE, FOOT, SHOULDER, UPPER_ARM, FOREARM = (0.245, 0.246, 0.039, 0.152, 0.818, 0.186, 0.2)
REACH = 0.99 * (THIGH + SHANK)
HIP = REACH + ANKLE


class PersonBuild(NamedTuple):
    """Properties of a walking or standing person.

    Attributes:
        height, width: Metres.
        step: Distance between footfalls in m, 0 for a standing person.
        phase: Initial phase of the stride, 0 .. 1.
        hair, coat, trousers: Reflectances.
        carried: One of CARRIED.
        shift: x of the hips, m.
        lean: Backward tilt of a person who leans against a wall, rad.
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
    lean: float = 0.0


def make_pedestrian(
    rng: np.random.Generator, speed: float, child: bool = False, carried: str = "", lean: float = 0.0
) -> SceneObject:
    """Make a person who walks at a speed in m/s, or stands.

    The box encloses the body during a full stride, without a bag, umbrella, trolley or pram. Its
    length is at least MIN_LENGTH_RATIO of the height. The step length is proportional to the square
    root of the speed (Sekiya et al. 1996: step length / step rate is 0.0065 m min at all speeds).
    """
    _, width, height = draw_size(rng, CLASSES[PEDESTRIAN])
    if child:
        scale = rng.uniform(0.62, 0.8)
        width, height = width * max(scale, 0.7), height * scale
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
        lean=lean,
    )
    low, high = _measure_stride(build)
    build = build._replace(shift=-(low + high) / 2)
    size = (max(high - low, MIN_LENGTH_RATIO * height), build.width, height)
    return SceneObject(partial(pose_walker, build=build), size, CLASSES[PEDESTRIAN])


def _measure_stride(build: PersonBuild) -> tuple[float, float]:
    """Return the smallest and largest x of the body over half a stride; the other half is symmetric."""
    body = build._replace(carried="backpack" if build.carried == "backpack" else "", phase=0.0)
    poses = [_make_limb_parts(i / 24, body) for i in range(12 if build.step else 1)]
    rows = [row for limbs, _ in poses for row in limbs] + _make_trunk_parts(body, 0.0)
    low, _, _, high, _, _ = compute_hull(_lean_back(make_parts(rows, PERSON), build.lean))
    return low, high


def pose_walker(distance: float, build: PersonBuild) -> np.ndarray:
    """Return the parts (P,) PART of a person after a distance travelled in m.

    The last two rows before the load are the right and the left foot. Feet on the ground do not
    slip, and the hips are lower while the legs are apart.
    """
    strides = build.phase + (distance / (2 * build.step) if build.step else 0.0)
    limbs, dz = _make_limb_parts(strides, build)
    trunk = _make_trunk_parts(build, dz)
    parts = _lean_back(make_parts(trunk[:5] + limbs + trunk[5:], PERSON), build.lean)
    parts["centre"][:, 0] += build.shift
    return parts


def _lean_back(parts: np.ndarray, angle: float) -> np.ndarray:
    """Tilt the parts (P,) PART of a person backwards by an angle in rad, in place, without changing any height."""
    if angle:
        tangent, is_rod = tan(angle), parts["kind"] == CYLINDER
        parts["centre"][:, 0] -= tangent * parts["centre"][:, 2]
        yaw, pitch = parts["yaw"][is_rod], parts["pitch"][is_rod]
        x, y, z = np.sin(pitch) * np.cos(yaw) - tangent * np.cos(pitch), np.sin(pitch) * np.sin(yaw), np.cos(pitch)
        parts["yaw"][is_rod], parts["pitch"][is_rod] = np.arctan2(y, x), np.arctan2(np.hypot(x, y), z)
        parts["pitch"][parts["kind"] == ELLIPSOID] -= angle
    return parts


def _make_trunk_parts(build: PersonBuild, dz: float) -> list[tuple]:
    """Return face and hair, neck, chest, hips and load, shifted up by `dz` metres."""
    h, w = build.height, build.width
    return [
        ellipsoid((0.012 * h, 0, 0.93 * h + dz), (0.055 * h, 0.045 * h, 0.068 * h), SKIN),
        ellipsoid((-0.012 * h, 0, 0.948 * h + dz), (0.05 * h, 0.047 * h, 0.052 * h), build.hair),
        rod((0, 0, 0.8 * h + dz), (0.005 * h, 0, 0.89 * h + dz), 0.032 * h, SKIN),
        ellipsoid((0, 0, 0.70 * h + dz), (0.08 * h, min(0.125 * h, 0.42 * w), 0.15 * h), build.coat),
        ellipsoid((0, 0, 0.54 * h + dz), (0.075 * h, min(0.105 * h, 0.38 * w), 0.11 * h), build.trousers),
        *_make_load_parts(build.carried, h, w, dz, build.coat),
    ]


def _make_limb_parts(strides: float, build: PersonBuild) -> tuple[list[tuple], float]:
    """Return arms, legs and feet after a number of strides, and the vertical shift of the hips in m."""
    h = build.height
    feet = [_pose_foot((strides + phase) % 1.0, 2 * build.step, h) for phase in (0.0, 0.5)]
    hip = min(
        HIP * h, *(z + sqrt((REACH * h) ** 2 - min(0.88 * abs(x), 0.9 * REACH * h) ** 2) for _, _, (x, z) in feet)
    )
    dz, rows = hip - HIP * h, []
    for side, (phase, is_left) in zip((-1, 1), ((strides + 0.5, False), (strides, True))):
        rows += _make_arm_parts(side, phase, build, dz, is_left)
    for side, (_, _, ankle) in zip((-1, 1), feet):
        rows += _make_leg_parts(side, ankle, hip, h, build.trousers)
    for side, (toe, tilt, _) in zip((-1, 1), feet):
        cos_tilt, sin_tilt, half_length = cos(tilt), sin(tilt), FOOT * h / 2
        rows.append(
            box(
                (
                    toe[0] - half_length * cos_tilt + 0.02 * h * sin_tilt,
                    side * 0.055 * h,
                    toe[1] + half_length * sin_tilt + 0.02 * h * cos_tilt,
                ),
                (half_length, 0.03 * h, 0.02 * h),
                RUBBER,
                pitch=tilt,
            )
        )
    return rows, dz


def _pose_foot(phase: float, stride: float, h: float) -> tuple[tuple, float, tuple]:
    """Compute the pose of a foot at a phase (0 .. 1) of a stride. It is on the ground up to STANCE.

    Returns:
        Toe (x, z), tilt of the foot in rad (positive: heel up), and ankle (x, z). Positions are in
        m, relative to the hips in x and to the ground in z.
    """
    max_tilt = 0.6 * min(stride / (0.8 * h), 1.0)
    if phase < STANCE:
        x = (STANCE / 2 - phase) * stride
        lift, rise = 0.0, max(phase / STANCE - HEEL_OFF, 0.0) / (1 - HEEL_OFF)
    else:
        swing_phase = (phase - STANCE) / (1 - STANCE)
        smooth = swing_phase * swing_phase * (3 - 2 * swing_phase)
        x = stride * (STANCE * (smooth - 0.5))
        lift, rise = 0.03 * stride * sin(pi * swing_phase), 1.0 - smooth
    tilt = max_tilt * rise
    toe_distance = 0.7 * FOOT * h  # distance from the ankle to the toe
    cos_tilt, sin_tilt = cos(tilt), sin(tilt)
    toe = (x + toe_distance, lift)
    ankle = (
        toe[0] - toe_distance * cos_tilt + ANKLE * h * sin_tilt,
        lift + toe_distance * sin_tilt + ANKLE * h * cos_tilt,
    )
    return toe, tilt, ankle


def _make_leg_parts(side: int, ankle: tuple, hip: float, h: float, trousers: float) -> list[tuple]:
    """Return thigh and shank."""
    start = (0.12 * ankle[0], hip)
    x, z = find_knee(start, ankle, THIGH * h, SHANK * h)
    y = side * 0.055 * h
    return [
        rod((start[0], y, hip), (x, y, z), 0.05 * h, trousers),
        rod((x, y, z), (ankle[0], y, ankle[1]), 0.037 * h, trousers),
    ]


def find_knee(hip: tuple, ankle: tuple, thigh: float, shank: float) -> tuple[float, float]:
    """Return the position of the knee (x, z) between hip (x, z) and ankle (x, z), bent forward."""
    x, z = ankle[0] - hip[0], ankle[1] - hip[1]
    distance = hypot(x, z)
    x, z = x / distance, z / distance
    distance = min(distance, 0.9999 * (thigh + shank))
    projection = (thigh**2 - shank**2 + distance**2) / (2 * distance)
    bend = sqrt(max(thigh**2 - projection**2, 0.0))
    return hip[0] + projection * x - bend * z, hip[1] + projection * z + bend * x


def _make_arm_parts(side: int, phase: float, build: PersonBuild, dz: float, is_left: bool) -> list[tuple]:
    """Return upper arm and forearm, which swing with the opposite leg or hold the load."""
    h, w, coat = build.height, build.width, build.coat
    swing = 0.45 * min(build.step / (0.43 * h), 1.2) * cos(2 * pi * phase)
    bend = 0.3 if build.step else build.phase  # random for standing people
    if build.carried == "pram" or (build.carried == "umbrella" and is_left):
        swing, bend = 0.2, (1.1 if build.carried == "pram" else 2.2)
    elif build.carried == "trolley" and not is_left:
        swing, bend = -0.45, 0.0
    radius = 0.03 * h
    y = side * (w / 2 - radius)
    shoulder = (0.0, side * min(0.115 * h, w / 2 - 2 * radius), SHOULDER * h + dz)
    elbow = (UPPER_ARM * h * sin(swing), y, shoulder[2] - UPPER_ARM * h * cos(swing))
    hand = (elbow[0] + FOREARM * h * sin(swing + bend), y, elbow[2] - FOREARM * h * cos(swing + bend))
    return [rod(shoulder, elbow, radius, coat), rod(elbow, hand, radius, coat)]


def _make_load_parts(carried: str, h: float, w: float, dz: float, coat: float) -> list[tuple]:
    """Return the parts of a load that the person carries, pulls or pushes."""
    if carried == "backpack":
        return [ellipsoid((-0.1 * h, 0, 0.7 * h + dz), (0.07 * h, 0.085 * h, 0.13 * h), 0.5 * coat)]
    if carried == "bag":
        return [block((-0.15, -w / 2 - 0.05, 0.28 * h), (0.15, -w / 2 + 0.05, 0.28 * h + 0.3), 0.35, semantic=OTHER)]
    if carried == "umbrella":
        top = h + 0.25
        return [
            ellipsoid((0.08, 0, top - 0.11), (0.5, 0.5, 0.11), coat),
            rod((0.1, w / 2 - 0.06, 0.7 * h), (0.08, 0.02, top - 0.1), 0.01, METAL),
        ]
    if carried == "trolley":
        y = -w / 2 + 0.03
        return [
            block((-0.85, y - 0.18, 0.05), (-0.6, y + 0.18, 0.6), 0.25, semantic=OTHER),
            rod((-0.6, y, 0.6), (-0.25, y, 0.47 * h), 0.015, METAL, semantic=OTHER),
            disc((-0.72, y, 0.05), 0.05, 0.18, RUBBER, semantic=OTHER),
        ]
    if carried == "pram":
        return [
            ellipsoid((0.85, 0, 0.72), (0.42, 0.22, 0.2), 0.3, semantic=OTHER),
            ellipsoid((0.66, 0, 0.88), (0.25, 0.23, 0.2), 0.25, semantic=OTHER),
            rod((0.25, 0, 0.6 * h), (1.1, 0, 0.3), 0.02, METAL, semantic=OTHER),
            disc((0.55, 0, 0.14), 0.14, 0.27, RUBBER, transmission=0.6, semantic=OTHER),
            disc((1.15, 0, 0.12), 0.12, 0.25, RUBBER, transmission=0.6, semantic=OTHER),
        ]
    return []


def make_sitting_person(rng: np.random.Generator, has_chair: bool = True) -> SceneObject:
    """Make a sitting person whose box includes the chair.

    Without a chair, the person needs a bench with a seat at 0.45 m.
    """
    length, width, height = size = draw_size(rng, "Person_sitting")
    coat, trousers = rng.uniform(0.2, 0.85), rng.uniform(0.15, 0.75)
    front, back, seat = length / 2, -length / 2, 0.45
    hip, trunk_height = back + 0.22, height - seat
    knees, radius = front - 0.18, 0.05
    rows = [
        ellipsoid((hip + 0.04, 0, height - 0.115), (0.095, 0.08, 0.115), SKIN),
        ellipsoid((hip, 0, seat + 0.42 * trunk_height), (0.13, min(0.2, 0.36 * width), 0.38 * trunk_height), coat),
        ellipsoid((hip, 0, seat + 0.1), (0.15, min(0.18, 0.36 * width), 0.11), trousers),
    ]
    for side in (-1, 1):
        y = side * 0.1
        rows += [
            rod((hip, y, seat + 0.09), (knees, y, seat + 0.07), 0.075, trousers),
            rod((knees, y, seat + 0.07), (knees, y, 0.07), 0.055, trousers),
            block((front - 0.26, y - 0.05, 0.0), (front, y + 0.05, 0.08), RUBBER),
        ]
        y = side * (width / 2 - radius)
        elbow, hand = (hip, y, seat + 0.32 * trunk_height), (knees - 0.05, y, seat + 0.2)
        rows += [
            rod((hip, side * 0.3 * width, seat + 0.68 * trunk_height), elbow, radius, coat),
            rod(elbow, hand, radius, coat),
        ]
    if has_chair:
        rows += [
            block((back + 0.03, -0.22, seat - 0.04), (hip + 0.28, 0.22, seat), METAL, semantic=OTHER),
            block((back, -0.22, seat), (back + 0.03, 0.22, seat + 0.42), METAL, semantic=OTHER),
        ]
        rows += [rod((x, 0.0, 0.0), (x, 0.0, seat), 0.02, METAL, semantic=OTHER) for x in (back + 0.05, hip + 0.25)]
    else:
        rows.append(ellipsoid((back + 0.1, 0, seat + 0.45 * trunk_height), (0.1, 0.1, 0.2), coat))
    return make_rigid(make_parts(rows, PERSON), size, "Person_sitting")


def make_wheelchair(rng: np.random.Generator) -> SceneObject:
    """Make a person in a wheelchair, labelled Person_sitting. The box includes the wheelchair."""
    person = make_sitting_person(rng, has_chair=False)
    (length, width, height), radius = person.size, rng.uniform(0.28, 0.32)
    y, back = width / 2 - 0.03, -length / 2 + 0.3
    wheels = [disc((back, s * y, radius), radius, 0.02, RUBBER, transmission=WHEEL_TRANSMISSION) for s in (-1, 1)]
    wheels += [disc((length / 2 - 0.15, s * 0.8 * y, 0.1), 0.1, 0.02, RUBBER) for s in (-1, 1)]
    seat = [
        block((back - 0.2, -0.9 * y, 0.4), (back + 0.25, 0.9 * y, 0.44), METAL),
        block((back - 0.25, -0.9 * y, 0.44), (back - 0.2, 0.9 * y, 0.9), METAL),
    ]
    parts = np.concatenate([person.parts(0.0), make_parts(wheels + seat, OTHER)])
    return make_rigid(parts, (length, width, height), person.label)
