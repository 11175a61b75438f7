"""Poses of the sensor for tracking, from the source that the parameter ego.source selects."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import monotonic, thread_time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.nodes.interfaces import CLOUD
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.robot.transform_tree import JUMP_NS, MissingTransform, TransformTree
from lidar_perception.tracking.ego import NO_SOURCE, Odometry, choose_source, has_odometry
from lidar_perception.tracking.params import EgoParams
from lidar_perception.types import InputError
from lidar_perception.wire.messages import to_point_cloud
from msg_utils.stamps import SECOND_NS, to_ns

START, SCAN = "start", "scan"  # frame names used by KISS-ICP
ICP_MS = "kiss_icp_cpu_ms_median"
PAUSE_S = 1.0  # clouds are not held for this long after a wait for a pose has timed out
GRACE_NS = SECOND_NS  # time without a pose until ego.source auto switches to KISS-ICP
TIMED_SCANS = 100  # number of scans for the median CPU time of KISS-ICP
ODOMETRY_TIMEOUT_S = 2.0
MAX_OFFSET_NS = 10 * SECOND_NS  # a larger offset of odometry and detections means different clocks


class EgoInput:
    """Provides the pose of the sensor in a fixed frame at the stamp of each of its frames.

    Args:
        node: node with transforms.
        params: returns the current parameters of the group ego.
        clouds: True if the node subscribes to clouds, which wait for their poses, and passes them to
            find_pose(). False: subscribe to ~/input/points for KISS-ICP.

    Attributes:
        source: current source of the poses, see choose_source.
        is_mounting_known: True if the pose of the sensor in the child frame of the odometry is known.
    """

    def __init__(self, node: LidarNode, params: Callable[[], EgoParams], clouds: bool):
        self.node, self.params, self.clouds = node, params, clouds
        self.transforms = node.transforms
        self.source, self.is_mounting_known = NO_SOURCE, True
        self.icp: Odometry | None = None
        self.scans = TransformTree()
        self.scan_ns, self.scan_frame = 0, ""  # stamp and frame of the last scan given to KISS-ICP
        self.is_disconnected = False  # True if TF has no transform from the scan's frame to the detections' frame
        self.icp_restarts = 0  # counted because the origin of the poses changes with each restart
        self.icp_ms: deque[float] = deque(maxlen=TIMED_SCANS)  # CPU time of KISS-ICP for the last scans
        self.pose_problem = ""  # why the last frame has no pose
        self.first_unknown_ns: int | None = None  # stamp of the first frame without a pose (ego.source auto)
        self.late_since: float | None = None  # monotonic time at which poses began to be late
        setting = params().source
        if setting in ("auto", "odometry"):
            self.transforms.subscribe_to_odometry()
        elif setting == "tf":
            self.transforms.subscribe_to_tf()
        elif setting == "kiss_icp":
            self._start_icp()
        if clouds:
            self.transforms.other_checks.append(self.find_missing_pose)

    def find_pose(self, header: Any, xyz: np.ndarray | None = None) -> np.ndarray | None:
        """Return the (4, 4) pose of the frame with this header, or None if it is unknown.

        xyz: (N, 3) scan of the frame, if the node subscribes to clouds.
        """
        frame_id, stamp = header.frame_id, to_ns(header.stamp)
        if self.icp is not None and self.clouds and xyz is not None and len(xyz) and self._uses_scans():
            self._register(header, xyz)
        pose, self.pose_problem = None, ""
        try:
            source = self._select_source(frame_id, stamp)
            pose = self._look_up(source, frame_id, stamp, self.params().max_gap)
        except MissingTransform as error:
            self.pose_problem = str(error)
        if self.params().source == "auto":
            self._try_next_source(stamp, pose is not None)
        return pose

    def find_missing_pose(self, header: Any) -> str | None:
        """Return a description of the pose if a frame with this header should wait for it, or None.

        A newer frame may replace the waiting one, so the limit ego.max_wait applies to consecutive
        frames together. After a timeout, frames do not wait for PAUSE_S seconds.
        """
        stamp = to_ns(header.stamp)
        try:
            source = self._select_source(header.frame_id, stamp)
            if source != NO_SOURCE and not (source == "kiss_icp" and self.clouds):
                self._look_up(source, header.frame_id, stamp, None)
        except MissingTransform as error:
            if error.late:
                now, max_wait = monotonic(), self.params().max_wait
                self.late_since = self.late_since or now
                may_wait = (now - self.late_since) % (max_wait + PAUSE_S) < max_wait
                return "the pose at its stamp" if may_wait else None
        self.late_since = None
        return None

    def find_problem(self, frame_id: str, stamp: int) -> str | None:
        """Return the problem of the last frame's poses with its remedy, or None."""
        setting, odometry_child = self.params().source, self.transforms.odometry_child
        odometry_ns = self.transforms.odometry_ns
        if self.source == "odometry" and odometry_ns is not None:
            topic = self.node.resolve_topic_name("~/input/odometry")
            silence = monotonic() - self.transforms.odometry_arrival
            if silence > ODOMETRY_TIMEOUT_S and stamp - odometry_ns > self.params().max_gap * SECOND_NS:
                return (
                    f"no odometry on {topic} for {silence:.0f} s: assuming a sensor at rest; is the odometry running?"
                )
            if silence <= ODOMETRY_TIMEOUT_S and abs(odometry_ns - stamp) > MAX_OFFSET_NS:
                return (
                    f"the stamps of the odometry on {topic} are {abs(odometry_ns - stamp) / SECOND_NS:.0f} s "
                    f"{'ahead of' if odometry_ns > stamp else 'behind'} the detections, so its poses are ignored: do "
                    "both use the same clock (use_sim_time)?"
                )
        if setting == "tf" and self.source != "tf":
            fixed_frame = self.node.node_params.input.fixed_frame
            return (
                f"TF does not connect '{frame_id}' with '{fixed_frame}' (input.fixed_frame): tracks "
                "are relative to the sensor"
            )
        if setting in ("odometry", "kiss_icp") and self.source != setting:
            topic = "odometry" if setting == "odometry" else "points"
            return (
                f"no pose from {self.node.resolve_topic_name(f'~/input/{topic}')} yet: "
                "tracks are relative to the sensor"
            )
        if not self.is_mounting_known and frame_id:
            return (
                f"the odometry is for '{odometry_child}', the detections are in '{frame_id}', "
                "and TF does not connect them: they are assumed to coincide"
                + ("; its child_frame_id is empty" if not odometry_child else "")
            )
        if self.source == "kiss_icp" and self.is_disconnected:
            return (
                f"KISS-ICP gives poses of '{self.scan_frame}', the detections are in '{frame_id}', "
                "and TF does not connect them: tracks are relative to the sensor"
            )
        if self.pose_problem:
            return f"the pose of the sensor is unknown: {self.pose_problem}"
        return None

    def _select_source(self, frame_id: str, stamp: int) -> str:
        """Set self.source to the best available source that ego.source allows, and return it."""
        setting, available = self.params().source, {self.source}
        if self.transforms.odometry_ns is not None:
            available.add("odometry")
        if self.scan_ns:
            available.add("kiss_icp")
        if choose_source(setting, {"tf", *available}) == "tf" != self.source and self._is_connected(frame_id, stamp):
            available.add("tf")
        self.source, self.is_mounting_known = choose_source(setting, available), True
        if self.source == "odometry":
            self.is_mounting_known = self.transforms.is_connected_to_odometry(frame_id)
            if not self.is_mounting_known:
                self.transforms.subscribe_to_tf()
        if not self._uses_scans():
            self.icp = None  # release the memory of the map
            self.node.diagnostics.counts.pop(ICP_MS, None)
        return self.source

    def _is_connected(self, frame_id: str, stamp: int) -> bool:
        try:
            self._look_up("tf", frame_id, stamp, self.params().max_gap)
        except MissingTransform as error:
            return error.late
        return True

    def _uses_scans(self) -> bool:
        """Return True while scans are the best source."""
        return self.source in (NO_SOURCE, "kiss_icp")

    def _look_up(self, source: str, frame_id: str, stamp: int, max_gap: float | None) -> np.ndarray | None:
        at = np.array([stamp])
        if source == "kiss_icp":
            scan = self.scans.lookup(START, SCAN, stamp, max_gap)
            return scan @ self._look_up_pose_on_scan(frame_id.lstrip("/"), at, max_gap)
        if source == "odometry" and not self.is_mounting_known:
            return self.transforms.look_up_odometry_poses(at, max_gap)[0]
        if source == NO_SOURCE:
            return None
        return self.transforms.look_up_sensor_poses(source, frame_id, at, max_gap)[0]

    def _look_up_pose_on_scan(self, frame_id: str, at: np.ndarray, max_gap: float | None) -> np.ndarray:
        """Return the (4, 4) pose of a frame in the frame of the scans at times (1,) ns."""
        if not frame_id or frame_id == self.scan_frame:
            self.is_disconnected = False
            return np.eye(4)
        self.transforms.subscribe_to_tf()
        try:
            poses: np.ndarray = self.transforms.tree.lookup_many(self.scan_frame, frame_id, at, max_gap)
        except MissingTransform as error:
            self.is_disconnected = not error.late
            raise
        self.is_disconnected = False
        return poses[0]

    def _try_next_source(self, stamp: int, has_pose: bool) -> None:
        """Fall back to TF if there is no odometry, and to KISS-ICP if there is no pose in TF either."""
        if self.source in ("odometry", "tf") or has_pose:
            self.first_unknown_ns = None
            return
        self.transforms.subscribe_to_tf()
        if self.first_unknown_ns is None or stamp < self.first_unknown_ns:
            self.first_unknown_ns = stamp
        if stamp - self.first_unknown_ns >= GRACE_NS and self.icp is None and has_odometry():
            self._start_icp()

    def _start_icp(self) -> None:
        self.icp = Odometry()
        if not self.clouds:
            self.node.inputs.subscribe("points", CLOUD, self._on_cloud)

    def _on_cloud(self, msg: Any) -> None:
        if not self._uses_scans():
            return
        xyz = to_point_cloud(msg)[0].xyz
        if not len(xyz):
            raise InputError("the cloud has no usable point, so the sensor motion is unknown")
        self._register(msg.header, xyz)

    def _register(self, header: Any, xyz: np.ndarray) -> None:
        stamp_ns = to_ns(header.stamp)
        if self.scan_ns - JUMP_NS <= stamp_ns <= self.scan_ns:
            return  # repeated or late stamp, which the tracker rejects and reports
        gap = (stamp_ns - self.scan_ns) / SECOND_NS
        if not 0 < gap <= 2 * self.params().max_gap:  # the map is from another place or time
            self.icp, self.scans = Odometry(), TransformTree()
            self.icp_restarts += 1
        self.scan_ns, self.scan_frame = stamp_ns, header.frame_id.lstrip("/")
        assert self.icp is not None  # created with the first scan
        begin = thread_time()
        pose = self.icp(xyz)
        self.icp_ms.append((thread_time() - begin) * 1e3)
        self.node.diagnostics.counts[ICP_MS] = f"{np.median(self.icp_ms):.1f}"
        self.scans.set(START, SCAN, stamp_ns, pose[:3, 3], Rotation.from_matrix(pose[:3, :3]).as_quat())
        self.node.diagnostics.counts["last_pose_ns"] = stamp_ns
