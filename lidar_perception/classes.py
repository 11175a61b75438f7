"""Table of the object classes and their constants: a new class is one row.

Names are those of KITTI's labels. Classes with `numbers` are detected and scored; the others occur
in labels only. The shapes of simulated objects are in simulation/shapes/.
"""

from __future__ import annotations

from dataclasses import dataclass

Size = tuple[float, float, float]  # (length, width, height) in metres


@dataclass(frozen=True)
class DetectionNumbers:
    """Constants of a detected class.

    anchor: anchor box of PointPillars; positive at a BEV IoU of at least `matched`, background
        below `unmatched` (Lang et al., CVPR 2019, Section 4.1 and its code).
    mean_size: mean of KITTI's labels, to which PointNet's sizes are relative.
    min_diagonal: smallest diagonal of a cluster's box in x-y, in metres (paper B, Table 2, whose
        ranges 0.40-1.71, 1.72-2.99 and 3.00-6.40 are rounded; here each extends to the next).
    strict, relaxed: minimum IoU of a hit, as in KITTI and for small objects.
    """

    anchor: Size
    matched: float
    unmatched: float
    mean_size: Size
    min_diagonal: float
    strict: float
    relaxed: float


@dataclass(frozen=True)
class ObjectClass:
    """A class of objects.

    looks_like: class whose detections on this object are ignored, as in KITTI's benchmark.
    vehicle: True if it can contain people.
    moves_as: vehicle, pedestrian or cyclist, for the tracker.
    aliases: names of the class in other stacks.
    """

    name: str
    numbers: DetectionNumbers | None = None
    looks_like: str = ""
    vehicle: bool = False
    moves_as: str = "vehicle"
    aliases: tuple[str, ...] = ()


TABLE = (
    ObjectClass(
        "Car",
        DetectionNumbers((3.9, 1.6, 1.56), 0.6, 0.45, (3.88, 1.63, 1.53), 3.00, 0.7, 0.5),
        vehicle=True,
        aliases=("vehicle", "automobile"),
    ),
    ObjectClass("Van", looks_like="Car", vehicle=True),
    ObjectClass("Truck", vehicle=True),
    ObjectClass(
        "Pedestrian",
        DetectionNumbers((0.8, 0.6, 1.73), 0.5, 0.35, (0.84, 0.66, 1.76), 0.40, 0.5, 0.25),
        moves_as="pedestrian",
        aliases=("person", "people", "human"),
    ),
    ObjectClass("Person_sitting", looks_like="Pedestrian", moves_as="pedestrian"),
    ObjectClass(
        "Cyclist",
        DetectionNumbers((1.76, 0.6, 1.73), 0.5, 0.35, (1.76, 0.60, 1.74), 1.72, 0.5, 0.25),
        moves_as="cyclist",
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
BY_SIZE = sorted(DETECTED, key=lambda name: -DETECTED[name].min_diagonal)  # classes, largest first
CAR, PEDESTRIAN, CYCLIST, DONT_CARE = map(CLASSES.index, ("Car", "Pedestrian", "Cyclist", "DontCare"))


def class_name(text: str) -> str:
    """Return the name in CLASSES that a text spells, else the text itself.

    Case, blanks and punctuation are ignored: "car", "Person (sitting)".
    """
    return _NAME_BY_SPELLING.get("".join(filter(str.isalnum, text)).casefold(), text)
