"""What was recorded to a bag of a running graph: answers beside the labels of their frames."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from lidar_perception.data.bag import Bag, BagHandle
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.wire.topics import TRUTH
from msg_utils.markers import MarkedObjects, from_marker_array


@dataclass(frozen=True)
class RecordedResult:
    """The labels of a frame, and what a node said of it."""

    stamp_ns: int
    truth: MarkedObjects
    found: MarkedObjects


def read_results(path: Path, *topics: str) -> list[list[RecordedResult]]:
    """For each of these topics of a bag, the labelled frames that have an answer on it, in order of
    time; of equal stamps the last. Answers are in the frame of the labels; InputError where nothing
    connects theirs with it."""
    opened = BagHandle(path)
    found = read_objects_by_stamp(opened.bag(), (*topics, TRUTH))
    truth = found[TRUTH]
    poses = BagPoses(opened, next((each.frame_id for each in truth.values()), ""))
    return [[RecordedResult(stamp, truth[stamp], poses.to_cloud_frame(found[topic][stamp], topic))
             for stamp in sorted(found[topic].keys() & truth.keys())] for topic in topics]


def read_objects_by_stamp(bag: Bag, topics: Iterable[str]) -> dict[str, dict[int, MarkedObjects]]:
    """By topic and header.stamp what is marked on MarkerArray topics of a bag; of equal stamps the
    last. Nothing on a topic that the bag does not have."""
    found: dict[str, dict[int, MarkedObjects]] = {topic: {} for topic in topics}
    for topic, _, message in bag.messages(found.keys() & bag.topics.keys()):
        objects = from_marker_array(message)
        found[topic][objects.stamp_ns] = objects
    return found
