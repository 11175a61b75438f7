"""Results of ROS nodes in a bag, with the labels of the same frames."""

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
    """Labels of a frame, and the objects that a node published for it."""

    stamp_ns: int
    truth: MarkedObjects
    objects: MarkedObjects


def read_results(path: Path, *topics: str) -> list[list[RecordedResult]]:
    """Read the results of labelled frames from each topic, in order of time.

    Results are transformed to the coordinate frame of the labels. If several messages have the same stamp,
    the last one is used.

    Raises:
        InputError: No transform connects the results with the labels.
    """
    handle = BagHandle(path)
    objects = read_objects_by_stamp(handle.get_bag(), (*topics, TRUTH))
    truth = objects[TRUTH]
    poses = BagPoses(handle, next((labels.frame_id for labels in truth.values()), ""))
    return [
        [
            RecordedResult(stamp, truth[stamp], poses.to_cloud_frame(objects[topic][stamp], topic))
            for stamp in sorted(objects[topic].keys() & truth.keys())
        ]
        for topic in topics
    ]


def read_objects_by_stamp(bag: Bag, topics: Iterable[str]) -> dict[str, dict[int, MarkedObjects]]:
    """Read the objects of MarkerArray topics, by topic and header.stamp.

    If several messages have the same stamp, the last one is used. A topic that is not in the bag
    has no objects.
    """
    objects_by_topic: dict[str, dict[int, MarkedObjects]] = {topic: {} for topic in topics}
    for topic, _, message in bag.messages(objects_by_topic.keys() & bag.topics.keys()):
        objects = from_marker_array(message)
        objects_by_topic[topic][objects.stamp_ns] = objects
    return objects_by_topic
