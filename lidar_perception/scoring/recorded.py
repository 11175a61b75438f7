"""What was recorded to a bag of a running graph: answers beside the labels of their frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lidar_perception.data.bag import Bag
from lidar_perception.wire.topics import TRUTH
from msg_utils.markers import MarkedObjects, from_marker_array


@dataclass(frozen=True)
class Answered:
    """The labels of a frame, and what a node said of it."""

    stamp_ns: int
    truth: MarkedObjects
    found: MarkedObjects


def answered(path: Path, *topics: str) -> list[list[Answered]]:
    """For each of these topics of a bag, the labelled frames that have an answer on it, in order of
    time; of equal stamps the last."""
    by_stamp: dict[str, dict[int, MarkedObjects]] = {topic: {} for topic in (*topics, TRUTH)}
    with Bag(path) as bag:
        for where, _, msg in bag.messages(by_stamp.keys() & bag.topics.keys()):
            objects = from_marker_array(msg)
            by_stamp[where][objects.stamp_ns] = objects
    truth = by_stamp[TRUTH]
    return [[Answered(stamp, truth[stamp], by_stamp[topic][stamp])
             for stamp in sorted(by_stamp[topic].keys() & truth.keys())] for topic in topics]
