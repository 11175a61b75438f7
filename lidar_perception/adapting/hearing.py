"""Which sources are asked about an object: those that recognise such objects in simulated scans of
this sensor, where it is known what is there.

Silhouettes need many beams, and weights of PointPillars know the sensor that they were trained for.
What says no to everything says nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from lidar_perception.adapting.looking import SAME, FrameLook
from lidar_perception.classes import CAR, CLASSES, DETECTED, PEDESTRIAN
from lidar_perception.data.frame import Frame
from lidar_perception.geometry import centre_distances

AGREE = 0.4       # a source agrees from this probability on
POINTS = 10       # in the box of an object that counts, at least
FEWEST = 5        # objects by which a source is judged
RECOGNISED = 0.5  # share of them from which on it is asked

NAMES = {"network": "PointPillars", "silhouette": "the silhouette",
         "classifier": "the cluster network"}  # for people

# By class, the sources that may speak against an object of it.
Heard = Mapping[int, Sequence[str]]
ALL: Heard = {CLASSES.index(name): ("network", "classifier") for name in DETECTED} | {
    PEDESTRIAN: ("network", "silhouette", "classifier")}  # silhouettes are of people on foot
# By class and source, how many of the simulated objects it agreed with, and of how many.
Counts = dict[str, dict[str, tuple[int, int]]]


def recognised(looker: Callable[[Frame, np.ndarray], FrameLook], frames: Iterable[Frame]) -> Counts:
    """How many of the labelled objects that are detected in frames each source agrees with."""
    counts = {CLASSES[class_id]: dict.fromkeys(sources, (0, 0)) for class_id, sources in
              ALL.items()}
    for frame in frames:
        look, truth = looker(frame, np.eye(4)), frame.truth()
        if truth is None:
            continue
        found = look.detections
        for class_id, sources in ALL.items():
            own = np.flatnonzero((found.class_ids == class_id) & (look.counts >= POINTS))
            apart = centre_distances(found.boxes[own], truth.boxes[truth.class_ids == class_id])
            right = own[(apart < SAME[class_id == CAR]).any(axis=1)]
            for name in sources:
                said = found.sources[name][right]
                yes, of = counts[CLASSES[class_id]][name]
                counts[CLASSES[class_id]][name] = (yes + int((said >= AGREE).sum()),
                                                   of + int(np.isfinite(said).sum()))
    return counts


def heard_of(counts: Counts) -> Heard:
    """The sources that are asked: all but those that were seen to miss most objects of a class; of
    one with less than FEWEST, those of all classes."""
    return {CLASSES.index(of): tuple(name for name in each if _asked(*_judged_by(counts, of, name)))
            for of, each in counts.items()}


def unheard(counts: Counts) -> list[str]:
    """What to say of each class of which a source is not asked."""
    return [f"{of}: {NAMES[name]} is not asked: it recognises {yes} of {asked} simulated objects"
            + " of all classes" * (counts[of][name][1] < FEWEST)
            for of, each in counts.items() for name in each
            for yes, asked in [_judged_by(counts, of, name)] if not _asked(yes, asked)]


def _asked(yes: int, asked: int) -> bool:
    return asked < FEWEST or yes >= RECOGNISED * asked


def _judged_by(counts: Counts, of: str, name: str) -> tuple[int, int]:
    own = counts[of][name]
    if own[1] >= FEWEST:
        return own
    every = [each[name] for each in counts.values() if name in each]
    return sum(yes for yes, _ in every), sum(asked for _, asked in every)
