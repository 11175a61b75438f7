"""Labelled frames from a KITTI folder or a bag, one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from lidar_perception.camera import Camera
from lidar_perception.data.bag import Bag
from lidar_perception.data.kitti.folder import KittiFrame, open_kitti
from lidar_perception.types import GroundTruth, InputError, LidarFrame
from lidar_perception.wire.messages import camera_of, to_frame, to_truth
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, POINTS, TRUTH
from msg_utils.markers import from_marker_array
from msg_utils.stamps import to_ns


@dataclass(frozen=True)
class Recorded:
    """One frame; truth and camera are None where the recording has none."""

    name: str
    frame: LidarFrame
    truth: GroundTruth | None = None
    camera: Camera | None = None


@dataclass(frozen=True)
class Recording:
    """Frames of a KITTI folder or a bag. Iterating yields Recorded, or the InputError of a frame
    that cannot be read, so that the others go on; count is how many to expect."""

    path: Path
    count: int
    frames: list[KittiFrame] | None = None
    points_topic: str = POINTS

    def __iter__(self) -> Iterator[Recorded | InputError]:
        return _kitti(self.frames) if self.frames is not None else _bag(self)


def open_recording(*, kitti: str | Path | None = None, bag: str | Path | None = None,
                   points_topic: str = POINTS) -> Recording:
    """Exactly one of kitti and bag. InputError if there is nothing to read."""
    if kitti is not None:
        frames = open_kitti(kitti)
        return Recording(Path(kitti), len(frames), frames)
    with Bag(bag) as opened:
        opened.require(points_topic)
        return Recording(Path(bag), opened.counts[points_topic], None, points_topic)


def _kitti(frames: list[KittiFrame]) -> Iterator[Recorded | InputError]:
    for f in frames:
        try:
            yield Recorded(f.name, f.load(), f.truth(), f.calibration().camera())
        except InputError as error:
            yield error


def _bag(recording: Recording) -> Iterator[Recorded | InputError]:
    with Bag(recording.path) as bag:
        # The labels and calibrations first: they are small, and may come after their cloud.
        truth, infos, transforms = {}, [], []
        for topic, stamp, msg in bag.messages({TRUTH, CAMERA_INFO, EXTRINSICS} & set(bag.topics)):
            if topic == TRUTH:
                objects = from_marker_array(msg)
                truth[objects.stamp_ns or stamp] = to_truth(objects)
            else:
                (infos if topic == CAMERA_INFO else transforms).append((stamp, msg))
        for _, stamp, msg in bag.messages({recording.points_topic}):
            try:
                frame, _ = to_frame(msg, intensity_max=0.0)
                info, transform = _latest(infos, stamp), _latest(transforms, stamp)
                camera = camera_of(info, transform) if info and transform else None
                yield Recorded(str(to_ns(msg.header.stamp)), frame, truth.get(frame.stamp_ns),
                               camera)
            except InputError as error:
                yield error


def _latest(messages: list, stamp: int):
    """The last message up to stamp, or else the first: latched topics hold from the start."""
    before = [m for s, m in messages if s <= stamp]
    return before[-1] if before else messages[0][1] if messages else None
