"""The classes of objects, and every number that belongs to one of them: a new class is one row.

Names are those of KITTI's labels. A row with `numbers` is a class that the detectors are trained
to detect and that is scored; the others are labelled only. What a simulated object of a class looks
like is in simulation/shapes/, as each has a shape of its own.
"""

from __future__ import annotations

from dataclasses import dataclass

Size = tuple[float, float, float]  # length, width, height, metres


@dataclass(frozen=True)
class Numbers:
    """Of a class that is detected.

    anchor: of PointPillars, with the overlaps seen from above from which it is learned as the class
    (matched) and below which as background (unmatched): Lang et al., CVPR 2019, Section 4.1 and its
    code. mean_size: of KITTI's labels, which the cluster network's sizes are relative to.
    min_diagonal: of a cluster's box seen from above, metres: paper B, Table 2, whose ranges
    0.40-1.71, 1.72-2.99 and 3.00-6.40 are rounded; here each extends to the next. strict, relaxed:
    the overlaps that make a hit, KITTI's and the ones for small objects.
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
    """looks_like: a class that it is taken for without harm, as KITTI's benchmark does; vehicle:
    whether people can be in it; moves_as: vehicle, pedestrian or cyclist, for
    the tracker; called: what detectors of other stacks call it."""

    name: str
    numbers: Numbers | None = None
    looks_like: str = ""
    vehicle: bool = False
    moves_as: str = "vehicle"
    called: tuple[str, ...] = ()


TABLE = (
    ObjectClass("Car", Numbers((3.9, 1.6, 1.56), 0.6, 0.45, (3.88, 1.63, 1.53), 3.00, 0.7, 0.5),
                vehicle=True, called=("vehicle", "automobile")),
    ObjectClass("Van", looks_like="Car", vehicle=True),
    ObjectClass("Truck", vehicle=True),
    ObjectClass("Pedestrian", Numbers((0.8, 0.6, 1.73), 0.5, 0.35, (0.84, 0.66, 1.76), 0.40, 0.5,
                                      0.25), moves_as="pedestrian",
                called=("person", "people", "human")),
    ObjectClass("Person_sitting", looks_like="Pedestrian", moves_as="pedestrian"),
    ObjectClass("Cyclist", Numbers((1.76, 0.6, 1.73), 0.5, 0.35, (1.76, 0.60, 1.74), 1.72, 0.5,
                                   0.25), moves_as="cyclist",
                called=("bicycle", "bicyclist", "rider")),
    ObjectClass("Tram", vehicle=True),
    ObjectClass("Misc"),
    ObjectClass("DontCare"),
)
MAX_DIAGONAL = 6.40  # metres, of the largest class: paper B, Table 2

CLASSES = tuple(row.name for row in TABLE)
# Into CLASSES, by all that a class is called, in lower case
_NAME_BY_SPELLING = {"".join(filter(str.isalnum, name)).casefold(): name for name in CLASSES}
CALLED = {name.casefold(): i for i, row in enumerate(TABLE) for name in (row.name, *row.called)}
DETECTED = {row.name: row.numbers for row in TABLE if row.numbers is not None}
BY_SIZE = sorted(DETECTED, key=lambda name: -DETECTED[name].min_diagonal)  # the largest first
CAR, PEDESTRIAN, CYCLIST, DONT_CARE = map(CLASSES.index, ("Car", "Pedestrian", "Cyclist",
                                                          "DontCare"))


def class_name(text: str) -> str:
    """Return the name in CLASSES that a text spells in any case, with any blanks and punctuation
    ("car", "Person (sitting)"), or else the text."""
    return _NAME_BY_SPELLING.get("".join(filter(str.isalnum, text)).casefold(), text)
