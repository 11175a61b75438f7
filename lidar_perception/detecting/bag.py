"""Output of results to a rosbag2 bag with the topics of the nodes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np

from lidar_perception.data.bag import BagWriter
from lidar_perception.data.frame import return_none
from lidar_perception.data.to_bag import DETECTIONS_3D, MARKERS, FrameWriter
from lidar_perception.detecting.formats import Run
from lidar_perception.detecting.results import FrameResult
from lidar_perception.types import Detections, InputError, PointCloud
from lidar_perception.wire.array_codec import encode_detection_array, encode_markers
from lidar_perception.wire.messages import make_detection_rows, make_pose_covariances
from lidar_perception.wire.topics import DETECTIONS, TRACKS
from lidar_perception.wire.track_markers import make_track_rows
from msg_utils.markers import MarkerRow, list_marker_keys


class BagFormat:
    """Output format that writes the results of a run to the bag bag/.

    The bag contains detections, optionally tracks and clouds, and the recording's labels, camera
    and odometry. Detections and tracks are MarkerArray and Detection3DArray messages on the topics
    of the nodes. All messages have the stamp of their cloud.

    Args:
        with_clouds: True to write the clouds.
        with_tracks: True to write tracks.
    """

    def __init__(self, run: Run, with_clouds: bool, with_tracks: bool) -> None:
        self.run, self.needs_scans = run, with_clouds
        self.path = run.out / "bag"
        self.detections_topic = f"/{run.header['detector']}_detector{DETECTIONS}"
        self.tracks_topic = f"/tracker{TRACKS}" if with_tracks else None
        self.bag = BagWriter(self.path, force=True)
        self._marker_keys: dict[str, Any] = {}  # topic -> keys of the markers in its last message

    def __enter__(self) -> Self:
        self.bag.__enter__()
        self.writer = FrameWriter(self.bag, clouds=self.needs_scans)
        for topic in filter(None, (self.detections_topic, self.tracks_topic)):
            self.bag.add_topic(topic, MARKERS)
            self.bag.add_topic(f"{topic}_3d", DETECTIONS_3D)
        return self

    def __exit__(self, *error: Any) -> None:
        self.bag.__exit__(*error)

    def add(self, result: FrameResult) -> None:
        """Write a frame, or list it as skipped if a bag cannot represent it."""
        frame = result.frame
        if not self.needs_scans:  # only the frame_id of the cloud is used
            empty_cloud = PointCloud(np.zeros((0, 3), np.float32), frame_id=result.frame_id)
            frame = replace(frame, load=lambda: empty_cloud)
        try:
            content = self.writer.read(frame)
        except InputError:
            try:  # again without the labels, which may have caused the error
                content = self.writer.read(replace(frame, truth=return_none))
            except InputError as error:
                self.run.skipped.append(f"not in {self.path}: {error}")
                return
        header, stamp_ns = content.header, content.stamp_ns
        previous_keys = self._marker_keys.get(self.detections_topic, ())
        self._write_markers(
            self.detections_topic, stamp_ns, header, make_detection_rows(result.detections, previous_keys)
        )
        self._write_3d(
            self.detections_topic,
            stamp_ns,
            header,
            result.detections,
            covariances=make_pose_covariances(result.detections.class_ids),
        )
        if self.tracks_topic is not None and (tracks := result.tracks) is not None:
            self._write_markers(
                self.tracks_topic,
                stamp_ns,
                header,
                make_track_rows(
                    tracks.ids,
                    tracks.detections,
                    tracks.velocities,
                    tracks.moving,
                    result.trails,
                    previous=self._marker_keys.get(self.tracks_topic, ()),
                ),
            )
            self._write_3d(
                self.tracks_topic,
                stamp_ns,
                header,
                tracks.detections,
                ids=tracks.ids,
                covariances=tracks.to_pose_covariances(),
            )
        self.writer.write(content)

    def _write_markers(self, topic: str, stamp_ns: int, header: Any, rows: list[MarkerRow]) -> None:
        self._marker_keys[topic] = list_marker_keys(rows)
        self.bag.write(topic, stamp_ns, encode_markers(rows, header))

    def _write_3d(self, topic: str, stamp_ns: int, header: Any, detections: Detections, **options: Any) -> None:
        self.bag.write(
            f"{topic}_3d",
            stamp_ns,
            encode_detection_array(detections.boxes, detections.labels, detections.scores, header=header, **options),
        )
