"""Labels in a rosbag2 bag, as MarkerArray and Detection3DArray, with or without clouds.

A message belongs to the frame with the same header.stamp. Numbers are stored without rounding.
Detection3DArray has a class, score and id for each box; other fields are in the text of the
markers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lidar_perception.data.bag import Bag, BagHandle
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.data.frame import Frame, read_frame_id
from lidar_perception.data.to_bag import write_bag
from lidar_perception.labels.drive_labels import NO_TRACK, DriveLabels, FrameLabels, to_ground_truth
from lidar_perception.types import InputError
from lidar_perception.wire.topics import TRUTH
from msg_utils.detections import from_detection_array
from msg_utils.markers import MarkedObjects, from_marker_array

MARKERS, DETECTIONS = "visualization_msgs/msg/MarkerArray", "vision_msgs/msg/Detection3DArray"


def read(path: Path, frames: Sequence[Frame], topic: str = TRUTH) -> DriveLabels:
    """Read the boxes on a topic with MarkerArray or Detection3DArray messages of any node.

    Track ids are read from `track_id` in the text of label markers and from `id` in the text of
    track markers. The ids of a Detection3DArray are used as track ids unless they only number the
    boxes in each message.
    """
    stamps = {frame.stamp_ns for frame in frames}
    with Bag(path) as bag:
        bag.require(topic)
        if bag.topics[topic] not in (MARKERS, DETECTIONS):
            raise InputError(
                f"{path}: {topic} has the type {bag.topics[topic]}, but labels need {MARKERS} or {DETECTIONS}; "
                "choose another topic"
            )
        are_markers = bag.topics[topic] == MARKERS
        objects_by_stamp: dict[int, MarkedObjects] = {}
        poses = BagPoses(BagHandle(path), read_frame_id(frames))
        for _, time, msg in bag.messages({topic}):
            objects = from_marker_array(msg) if are_markers else from_detection_array(msg)
            stamp_ns = objects.stamp_ns or (0 if 0 in stamps else time)
            objects_by_stamp[stamp_ns] = poses.to_cloud_frame(objects, topic)
    if unknown_stamps := sorted(objects_by_stamp.keys() - stamps):
        raise InputError(
            f"{path}: {topic} has labels at {unknown_stamps[0]} ns, but the drive has no frame with this stamp "
            f"({len(unknown_stamps)} of {len(objects_by_stamp)} stamps are unknown); give the drive that was labelled"
        )
    has_ids = are_markers or any(sorted(o.ids.tolist()) != list(range(len(o))) for o in objects_by_stamp.values())
    return DriveLabels(
        [
            _make_frame_labels(
                frame,
                objects_by_stamp.get(frame.stamp_ns),
                are_markers,
                has_ids,
                f"{path}, {topic} at {frame.stamp_ns} ns",
            )
            for frame in frames
        ]
    )


def _make_frame_labels(
    frame: Frame, objects: MarkedObjects | None, are_markers: bool, has_ids: bool, source: str
) -> FrameLabels:
    if objects is None:
        return FrameLabels.of(frame.name, frame.stamp_ns)
    extra = [dict(e) for e in objects.extras]
    ids = [NO_TRACK] * len(objects)
    for k, fields in enumerate(extra):
        if are_markers:
            ids[k] = fields.pop("track_id", fields.pop("id", NO_TRACK) if "velocity" in fields else NO_TRACK)
        elif has_ids:
            ids[k] = int(objects.ids[k])
    scores = [e.pop("score", np.nan) for e in extra] if are_markers else objects.scores
    names = [e.pop("class_name", label) for e, label in zip(extra, objects.labels)]
    return FrameLabels.of(frame.name, frame.stamp_ns, objects.boxes, names, ids, scores, extra, objects.notes, source)


def write(labels: DriveLabels, out: Path, frames: Sequence[Frame], force: bool = False, clouds: bool = True) -> None:
    """Write a bag with the labels, poses, calibration and, optionally, clouds of the frames."""
    write_bag(
        out,
        (
            replace(frame, truth=partial(to_ground_truth, frame_labels))
            for frame, frame_labels in zip(frames, labels.frames)
        ),
        force=force,
        clouds=clouds,
        detections_3d=True,
    )
