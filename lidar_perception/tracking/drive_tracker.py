"""Tracker for recordings, which restarts at each drive and reads the poses of the sensor."""

from __future__ import annotations

from itertools import islice

from lidar_perception.data.frame import POSES, Frame, Recording, is_same_drive
from lidar_perception.tracking.ego import (
    NO_SOURCE,
    choose_recorded_source,
    has_odometry,
    is_valid_pose,
    make_pose_reader,
)
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.state import Tracks
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import Detections, InputError

MAX_POSE_CHECKS = 50  # maximum number of frames at the start of a recording to search for a pose


class DriveTracker:
    """Tracker for the detections of a recording: tracker(frame, detections) -> Tracks.

    Call it for each frame in order of time. All tracks end when a new drive begins: at a new
    sequence or, if the recording has no sequences (such as a bag), at a jump of the stamps, see
    data.frame. Track ids are unique within the recording.

    Args:
        ego: Source of the poses, one of RECORDED_EGO; see choose_ego_source. kiss_icp loads every
            frame.

    Attributes:
        drive: Name of the drive that the last frame belongs to.
        has_pose: True if the last frame had a pose, or if ego is "none".
    """

    def __init__(self, recording: Recording, params: TrackingParams = TrackingParams(), ego: str = "auto") -> None:
        self.ego = choose_ego_source(recording, ego)
        self.tracker, self._read_pose = Tracker(params), make_pose_reader(self.ego)
        self.drive, self.has_pose = "", True
        self._last_frame = "", -1  # sequence and stamp of the previous frame
        self._drive_number = 0

    def __call__(self, frame: Frame, detections: Detections) -> Tracks:
        """Update the tracks with a frame and return them in its LiDAR frame.

        Raises:
            InputError: The pose of the frame cannot be read.
        """
        sequence, stamp_ns = self._last_frame
        if frame.sequence != sequence or not (frame.sequence or is_same_drive(stamp_ns, frame.stamp_ns)):
            self.tracker.reset()
            self._read_pose = make_pose_reader(self.ego)
            self._drive_number += 1
        self._last_frame = frame.sequence, frame.stamp_ns
        self.drive = frame.sequence or f"drive {self._drive_number}"
        pose = self._read_pose(frame)
        self.has_pose = pose is not None or self.ego == NO_SOURCE
        return self.tracker(detections, frame.stamp_ns, pose)


def choose_ego_source(recording: Recording, source: str = "auto") -> str:
    """Resolve "auto" to a source of the sensor's motion; return any other source unchanged.

    "auto" selects the first one that applies:

    1. the poses of the recording, if one of its first MAX_POSE_CHECKS frames has a pose
    2. KISS-ICP, if it is installed
    3. the poses of the recording, if it has any
    4. none
    """
    if source != "auto":
        return source
    return choose_recorded_source(
        POSES in recording.contents
        and (not has_odometry() or any(map(has_valid_pose, islice(recording.frames, MAX_POSE_CHECKS))))
    )


def has_valid_pose(frame: Frame) -> bool:
    """Return True if a frame has a valid pose.

    If the clocks of odometry and clouds differ, no frame has a valid pose.
    """
    try:
        return is_valid_pose(frame.pose())
    except InputError:  # reported when the frame is scored
        return False
