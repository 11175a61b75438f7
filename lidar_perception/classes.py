"""Table of the object classes and their constants. To add a class, add a row.

Names are those of KITTI's labels. Classes with detection constants are detected and scored; the
others occur in labels only. The shapes of simulated objects are in simulation/shapes/.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Size = tuple[float, float, float]  # (length, width, height) in metres
UNKNOWN_YAW_RAD = math.pi / math.sqrt(3.0)  # standard deviation of the uniform distribution over the circle


@dataclass(frozen=True)
class DetectionConstants:
    """Constants of a detected class.

    Attributes:
        anchor: size of the anchor box of PointPillars.
        matched: minimum BEV IoU of a positive anchor (Lang et al., CVPR 2019, Section 4.1).
        unmatched: BEV IoU below which an anchor is background.
        mean_size: mean size of KITTI's labels; PointNet's sizes are relative to it.
        min_diagonal: minimum diagonal of a cluster's box in x-y, in metres. The ranges 0.40-1.71,
            1.72-2.99 and 3.00-6.40 of paper B, Table 2, are rounded; here each extends to the next.
        strict: minimum IoU of a hit in KITTI's benchmark.
        relaxed: lower minimum IoU of a hit, for small objects.
        deviations: root mean square errors of detected boxes: x and y, z in metres, yaw in radians; 0:
            unknown. Measured with the fused detector, see docs/reference/messages.md.
    """

    anchor: Size
    matched: float
    unmatched: float
    mean_size: Size
    min_diagonal: float
    strict: float
    relaxed: float
    deviations: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ObjectClass:
    """A class of objects.

    Attributes:
        name: name in KITTI's labels.
        numbers: constants for detection; None if the class is not detected.
        looks_like: class whose detections on this object are ignored, as in KITTI's benchmark.
        vehicle: True if it can contain people.
        motion_model: motion model of the tracker: vehicle, pedestrian or cyclist.
        aliases: names of the class in other stacks.
    """

    name: str
    numbers: DetectionConstants | None = None
    looks_like: str = ""
    vehicle: bool = False
    motion_model: str = "vehicle"
    aliases: tuple[str, ...] = ()


TABLE = (
    ObjectClass(
        "Car",
        DetectionConstants((3.9, 1.6, 1.56), 0.6, 0.45, (3.88, 1.63, 1.53), 3.00, 0.7, 0.5, (0.19, 0.09, 0.13)),
        vehicle=True,
        aliases=("vehicle", "automobile"),
    ),
    ObjectClass("Van", looks_like="Car", vehicle=True),
    ObjectClass("Truck", vehicle=True),
    ObjectClass(
        "Pedestrian",
        DetectionConstants(
            (0.8, 0.6, 1.73), 0.5, 0.35, (0.84, 0.66, 1.76), 0.40, 0.5, 0.25, (0.13, 0.05, UNKNOWN_YAW_RAD)
        ),
        motion_model="pedestrian",
        aliases=("person", "people", "human"),
    ),
    ObjectClass("Person_sitting", looks_like="Pedestrian", motion_model="pedestrian"),
    ObjectClass(
        "Cyclist",
        DetectionConstants((1.76, 0.6, 1.73), 0.5, 0.35, (1.76, 0.60, 1.74), 1.72, 0.5, 0.25, (0.12, 0.07, 0.11)),
        motion_model="cyclist",
        aliases=("bicycle", "bicyclist", "rider"),
    ),
    ObjectClass("Tram", vehicle=True),
    ObjectClass("Misc"),
    ObjectClass("DontCare"),
)
MAX_DIAGONAL = 6.40  # maximum diagonal of the largest class in metres (paper B, Table 2)

CLASSES = tuple(row.name for row in TABLE)
_NAME_BY_SPELLING = {"".join(filter(str.isalnum, name)).casefold(): name for name in CLASSES}
# Lower-case name of a class -> index into CLASSES.
ID_BY_ALIAS = {name.casefold(): i for i, row in enumerate(TABLE) for name in (row.name, *row.aliases)}
DETECTED = {row.name: row.numbers for row in TABLE if row.numbers is not None}
CLASSES_BY_SIZE = sorted(DETECTED, key=lambda name: -DETECTED[name].min_diagonal)  # classes, largest first
CAR, PEDESTRIAN, CYCLIST, DONT_CARE = map(CLASSES.index, ("Car", "Pedestrian", "Cyclist", "DontCare"))


def find_class_name(text: str) -> str:
    """Return the name in CLASSES that matches a text, otherwise the text itself.

    Case, blanks and punctuation are ignored, as in "car" or "Person (sitting)".
    """
    return _NAME_BY_SPELLING.get("".join(filter(str.isalnum, text)).casefold(), text)
