"""Which of the objects that were followed are taken for real, and why: kept, rejected or ignored.

What is kept is learned as an object, what is rejected as background; what is ignored is learned as
neither. The numbers are those of simulated drives and of what a person, a cyclist and a car are;
none is fitted to labels of real ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lidar_perception.adapting.hearing import AGREE, ALL, NAMES, POINTS, Heard
from lidar_perception.adapting.tracks import Followed
from lidar_perception.classes import CAR, CLASSES, CYCLIST, PEDESTRIAN

KEPT, REJECTED, IGNORED = "kept", "rejected", "ignored"
STATES = (KEPT, REJECTED, IGNORED)

FEWEST = 4             # detections of an object that is kept
SURE = 0.6             # its score, at least
SHARE = 0.6            # of the frames from its first to its last
CLOSER, TURNED = 1.5, 4.0  # metres of range, degrees: views that differ
WEAK = 0.06            # of score and share: below, it is nothing that flickers up
MOVED = 1.0            # metres over the ground, for what moves
TALL = 2.3             # metres above the floor: no person is higher, nor one on a bicycle
THROUGH = 0.45         # of a box's sides: what is nearer to its middle is inside of it
FASTEST = 3.5          # m/s of a person on foot
# By class the least and the greatest length, width and height, metres, of those that are simulated.
SIZES = {CAR: ((2.6, 1.2, 1.1), (6.0, 2.4, 2.4)),
         PEDESTRIAN: ((0.2, 0.2, 0.9), (1.5, 1.3, 2.1)),
         CYCLIST: ((1.1, 0.3, 1.2), (2.4, 1.2, 2.1))}


@dataclass(frozen=True)
class Verdict:
    """state: of STATES; reason: why, in words."""

    state: str
    reason: str


def moves(track: Followed) -> bool:
    """Whether it went somewhere, evenly, and did not just wander about."""
    return track.way > MOVED and track.way > 2 * track.scatter


def judged(track: Followed, way: np.ndarray, heard: Heard = ALL) -> Verdict:
    """What is made of an object; way (F, 2): where the sensor was in all frames of the drive;
    heard: which sources are asked."""
    wrong = next(_wrong(track, way), None)
    if wrong is not None:
        return Verdict(REJECTED, wrong)
    doubt = next(_doubts(track, heard.get(track.class_id, ())), None)
    if doubt is not None:
        return Verdict(IGNORED, doubt)
    return Verdict(KEPT, f"{len(track)} times, score {track.score:.2f}, "
                         + ("moves" if moves(track) else "from several sides"))


def _wrong(track: Followed, way: np.ndarray) -> Iterator[str]:
    """What speaks against it for sure."""
    still = not moves(track)
    if 2 * _covering(track.boxes, way[track.frames]).sum() > len(track):
        yield "covers the sensor: the robot itself"
    if still and _covering(np.median(track.boxes, axis=0)[None], way).any():
        yield "the sensor drives through it"
    if track.class_id != CAR and still and np.median(track.tops) > TALL:
        yield f"stands, and is {np.median(track.tops):.1f} m high: a post or a trunk"
    if len(track) >= FEWEST and track.lasting < WEAK:
        yield f"flickers: score {track.score:.2f}, in {100 * track.share:.0f} % of the frames"
    low, high = map(np.array, SIZES.get(track.class_id, ((0.0,) * 3, (np.inf,) * 3)))
    size = np.median(track.boxes[:, 3:6], axis=0)
    if (size < low).any() or (size > high).any():
        yield "no {} is {:.1f} x {:.1f} x {:.1f} m".format(CLASSES[track.class_id], *size)


def _covering(boxes: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(n,) bool: whether places (n, 2) are well inside boxes (n or 1, 7), seen from above."""
    off = places - boxes[:, :2]
    cos, sin = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    return ((np.abs(cos * off[:, 0] + sin * off[:, 1]) < THROUGH * boxes[:, 3])
            & (np.abs(cos * off[:, 1] - sin * off[:, 0]) < THROUGH * boxes[:, 4]))


def _doubts(track: Followed, heard: Sequence[str]) -> Iterator[str]:
    """What keeps it from being sure."""
    if not heard:
        yield f"no source recognises a {CLASSES[track.class_id]} with this sensor"
    if len(track) < FEWEST:
        yield f"seen in {len(track)} frame{'s' * (len(track) != 1)} only"
    if track.score < SURE:
        yield f"score {track.score:.2f}"
    against = [f"{NAMES[name]} {p:.2f}" for name, p in track.said.items()
               if p < AGREE and name in heard]
    if against:
        yield f"not all agree: {', '.join(against)}"
    if track.share < SHARE:
        yield f"in {100 * track.share:.0f} % of the frames only"
    if track.counts.max() < POINTS:
        yield f"{track.counts.max()} points at most"
    if track.class_id != CAR and np.median(track.tops) > TALL:
        yield f"what moves there is {np.median(track.tops):.1f} m high"
    closer, turned = track.views
    if not moves(track) and closer < CLOSER and turned < TURNED:
        yield "stands, and was seen from one place only"
    seconds = max(float(np.ptp(track.seconds)), 1e-9)
    if track.class_id == PEDESTRIAN and moves(track) and track.way / seconds > FASTEST:
        yield f"too fast for a pedestrian: {track.way / seconds:.1f} m/s"
