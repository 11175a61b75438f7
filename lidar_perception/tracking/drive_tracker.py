"""Tracks of a whole recording, drive by drive, with the poses that it has."""

from __future__ import annotations

from itertools import islice

from lidar_perception.data.drives import is_same_drive
from lidar_perception.data.frame import POSES, Frame, Recording
from lidar_perception.tracking.ego import (
    NO_SOURCE,
    has_odometry,
    recorded_poses,
    recorded_source,
    usable,
)
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import Detections, InputError

LOOKED_AT = 50  # frames, the first ones, whether one of them has a pose


class DriveTracker:
    """Track the detections of a recording: tracker(frame, detections) -> Tracks.

    Call it for each frame in order of time. All tracks end where another drive begins: with
    another sequence, or in a recording without sequences, such as a bag, where the stamps jump (see
    data.drives). Ids go on, so no two tracks of a recording share one. ego, one of RECORDED_EGO,
    says where poses come from, see ego_of; kiss_icp loads every frame.

    After each call drive names the drive of the frame, and posed says whether its pose was known,
    or none was wanted.
    """

    def __init__(self, recording: Recording, params: TrackingParams = TrackingParams(),
                 ego: str = "auto") -> None:
        self.ego = ego_of(recording, ego)
        self.tracker, self.pose_of = Tracker(params), recorded_poses(self.ego)
        self.drive, self.posed = "", True
        self._last = "", -1  # sequence and stamp of the frame before
        self._number = 0     # of the drive

    def __call__(self, frame: Frame, detections: Detections) -> Tracks:
        """The tracks of the frame after these detections, in its LiDAR frame. InputError where its
        pose cannot be read."""
        sequence, stamp_ns = self._last
        if frame.sequence != sequence or not (
                frame.sequence or is_same_drive(stamp_ns, frame.stamp_ns)):
            self.tracker.reset()
            self.pose_of = recorded_poses(self.ego)
            self._number += 1
        self._last = frame.sequence, frame.stamp_ns
        self.drive = frame.sequence or f"drive {self._number}"
        pose = self.pose_of(frame)
        self.posed = pose is not None or self.ego == NO_SOURCE
        return self.tracker(detections, frame.stamp_ns, pose)


def ego_of(recording: Recording, wanted: str = "auto") -> str:
    """Where the sensor's motion comes from, of RECORDED_EGO all but auto, which is: the poses of
    the recording, where one of its first LOOKED_AT frames has one, else KISS-ICP, where that is
    installed, else those poses that there are, else none."""
    if wanted != "auto":
        return wanted
    return recorded_source(POSES in recording.has and (
        not has_odometry() or any(map(has_pose, islice(recording.frames, LOOKED_AT)))))


def has_pose(frame: Frame) -> bool:
    """Return True if a frame has a pose that can be used: odometry with another clock than the
    clouds' gives none."""
    try:
        return usable(frame.pose())
    except InputError:  # said where the frame is measured
        return False
