"""Results that a running graph recorded to a bag, with the labels of their frames."""

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
    """Labels of one frame, and the objects that a node published for it."""

    stamp_ns: int
    truth: MarkedObjects
    found: MarkedObjects


def read_results(path: Path, *topics: str) -> list[list[RecordedResult]]:
    """Read the results of labelled frames from each of several topics, in order of time.

    Results are in the frame of the labels. Of messages with equal stamps the last one counts.

    Raises:
        InputError: no transform connects the results with the labels.
    """
    opened = BagHandle(path)
    found = read_objects_by_stamp(opened.bag(), (*topics, TRUTH))
    truth = found[TRUTH]
    poses = BagPoses(opened, next((each.frame_id for each in truth.values()), ""))
    return [
        [
            RecordedResult(stamp, truth[stamp], poses.to_cloud_frame(found[topic][stamp], topic))
            for stamp in sorted(found[topic].keys() & truth.keys())
        ]
        for topic in topics
    ]


def read_objects_by_stamp(bag: Bag, topics: Iterable[str]) -> dict[str, dict[int, MarkedObjects]]:
    """Read the objects on MarkerArray topics by topic and header.stamp.

    Of messages with equal stamps the last one counts. A topic that is not in the bag is empty.
    """
    found: dict[str, dict[int, MarkedObjects]] = {topic: {} for topic in topics}
    for topic, _, message in bag.messages(found.keys() & bag.topics.keys()):
        objects = from_marker_array(message)
        found[topic][objects.stamp_ns] = objects
    return found
