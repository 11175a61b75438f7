"""How the sensor moves, from whatever the parameter ego.source names."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import monotonic, thread_time
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.nodes.runtime import CLOUD, JUMP_NS, LidarNode
from lidar_perception.robot.transform_tree import MissingTransform, TransformTree
from lidar_perception.tracking.ego import NO_SOURCE, Odometry, best_source, has_odometry
from lidar_perception.tracking.params import EgoParams
from lidar_perception.types import InputError
from lidar_perception.wire.messages import to_frame
from msg_utils.stamps import SECOND, to_ns

START, SCAN = "start", "scan"  # frames of KISS-ICP
ICP_MS = "kiss_icp_cpu_ms_median"
AGAIN = 1.0        # seconds without waiting where waiting for a pose was in vain
GRACE_NS = SECOND  # of frames without a pose; then ego.source auto takes the scans
TIMED = 100        # scans
SILENT = 2.0       # seconds without odometry
APART_NS = 10 * SECOND  # between odometry and detections: no lag, but another clock


class EgoInput:
    """Poses of the sensor in a fixed frame, by the stamps of its frames.

    source: what they come from now, of best_source; carried: whether it is known where the sensor
    is on what the odometry is of. clouds: whether the node itself takes the scans
    and hands them to pose(); then these wait for their poses, too. Otherwise they come from
    ~/input/points, for KISS-ICP alone.
    """

    def __init__(self, node: LidarNode, params: Callable[[], EgoParams], clouds: bool):
        self.node, self.params, self.clouds = node, params, clouds
        self.transforms = node.transforms
        self.source, self.carried = NO_SOURCE, True
        self.icp: Odometry | None = None
        self.scans = TransformTree()
        self.scan_ns, self.scan_frame = 0, ""  # of the last scan that KISS-ICP took
        self.apart = False  # TF does not connect it with the frame of the detections
        self.begun = 0  # how often KISS-ICP has begun, each time at an origin of its own
        self.icp_ms: deque[float] = deque(maxlen=TIMED)  # of CPU time, for the last ones
        self.unknown = ""  # why the source said no pose of the last frame
        self.without_ns: int | None = None  # since when frames have had no pose, with auto
        self.late_since: float | None = None  # monotonic: since then no pose has come in time
        wanted = params().source
        if wanted in ("auto", "odometry"):
            self.transforms.hear_odometry()
        elif wanted == "tf":
            self.transforms.listen()
        elif wanted == "kiss_icp":
            self._take_scans()
        if clouds:
            self.transforms.needs.append(self.needed)

    def pose(self, header: Any, xyz: np.ndarray | None = None) -> np.ndarray | None:
        """(4, 4) of the frame with this header; None where it is not known. xyz (N, 3) is its scan,
        where the node takes the clouds."""
        frame_id, stamp = header.frame_id, to_ns(header.stamp)
        if (self.icp is not None and self.clouds and xyz is not None and len(xyz)
                and self._by_scans()):
            self._register(header, xyz)
        pose, self.unknown = None, ""
        try:
            pose = self._of(self._source(frame_id, stamp), frame_id, stamp, self.params().max_gap)
        except MissingTransform as error:
            self.unknown = str(error)
        if self.params().source == "auto":
            self._look_further(stamp, pose is not None)
        return pose

    def needed(self, header: Any) -> str | None:
        """What a frame with this header waits for: its pose, where poses come but are a little
        behind. Frames together wait ego.max_wait seconds at most, as a newer one may take the place
        of the one that waits; where it was in vain none waits for a while."""
        stamp = to_ns(header.stamp)
        try:
            source = self._source(header.frame_id, stamp)
            if source != NO_SOURCE and not (source == "kiss_icp" and self.clouds):
                self._of(source, header.frame_id, stamp, None)
        except MissingTransform as error:
            if error.late:
                now, max_wait = monotonic(), self.params().max_wait
                self.late_since = self.late_since or now
                patient = (now - self.late_since) % (max_wait + AGAIN) < max_wait
                return "the pose of its time" if patient else None
        self.late_since = None
        return None

    def problem(self, frame_id: str, stamp: int) -> str | None:
        """What is wrong with the poses for frames in frame_id, the last one of this stamp, with the
        remedy."""
        wanted, carrier = self.params().source, self.transforms.carrier
        last = self.transforms.odometry_ns
        if self.source == "odometry" and last is not None:
            topic = self.node.resolve_topic_name("~/input/odometry")
            silent = monotonic() - self.transforms.odometry_came
            if silent > SILENT and stamp - last > self.params().max_gap * SECOND:
                return (f"no odometry on {topic} for {silent:.0f} s: the sensor is taken to stand; "
                        "is it running?")
            if silent <= SILENT and abs(last - stamp) > APART_NS:
                return (f"the odometry on {topic} is stamped {abs(last - stamp) / SECOND:.0f} s "
                        f"{'ahead of' if last > stamp else 'behind'} the detections, so none of "
                        "its poses is used: do both take the time from one clock (use_sim_time)?")
        if wanted == "tf" and self.source != "tf":
            fixed = self.node.robot.input.fixed_frame
            return (f"TF does not connect '{frame_id}' with '{fixed}' (input.fixed_frame): tracks "
                    "are relative to the sensor")
        if wanted in ("odometry", "kiss_icp") and self.source != wanted:
            topic = "odometry" if wanted == "odometry" else "points"
            return (f"no pose has come on {self.node.resolve_topic_name(f'~/input/{topic}')} yet: "
                    "tracks are relative to the sensor")
        if not self.carried and frame_id:
            return (f"the odometry is of '{carrier}', the detections of '{frame_id}', and TF does "
                    "not connect them: they are taken to be in one place"
                    + ("; its child_frame_id is empty" if not carrier else ""))
        if self.source == "kiss_icp" and self.apart:
            return (f"KISS-ICP moves with '{self.scan_frame}', the detections are in '{frame_id}', "
                    "and TF does not connect them: tracks are relative to the sensor")
        return f"the sensor's pose is not known: {self.unknown}" if self.unknown else None

    def _source(self, frame_id: str, stamp: int) -> str:
        """Of what there is, the best that ego.source allows; it is kept in self.source."""
        wanted, there = self.params().source, {self.source}
        if self.transforms.odometry_ns is not None:
            there.add("odometry")
        if self.scan_ns:
            there.add("kiss_icp")
        if best_source(wanted, {"tf", *there}) == "tf" != self.source and (
                self._connected(frame_id, stamp)):
            there.add("tf")
        self.source, self.carried = best_source(wanted, there), True
        if self.source == "odometry":
            self.carried = self.transforms.carries(frame_id)
            if not self.carried:
                self.transforms.listen()
        if not self._by_scans():
            self.icp = None  # with its map; scans are taken no longer
            self.node.counts.pop(ICP_MS, None)
        return self.source

    def _connected(self, frame_id: str, stamp: int) -> bool:
        try:
            self._of("tf", frame_id, stamp, self.params().max_gap)
        except MissingTransform as error:
            return error.late
        return True

    def _by_scans(self) -> bool:
        """Whether scans are of use: nothing better has come."""
        return self.source in (NO_SOURCE, "kiss_icp")

    def _of(self, source: str, frame_id: str, stamp: int,
            max_gap: float | None) -> np.ndarray | None:
        at = np.array([stamp])
        if source == "kiss_icp":
            scan = self.scans.lookup(START, SCAN, stamp, max_gap)
            return scan @ self._on_scan(frame_id.lstrip("/"), at, max_gap)
        if source == "odometry" and not self.carried:
            return self.transforms.odometry_poses(at, max_gap)[0]
        if source == NO_SOURCE:
            return None
        return self.transforms.sensor_poses(source, frame_id, at, max_gap)[0]

    def _on_scan(self, frame_id: str, at: np.ndarray, max_gap: float | None) -> np.ndarray:
        """(4, 4): where a frame is in that of the scans at times (1,) ns."""
        if not frame_id or frame_id == self.scan_frame:
            self.apart = False
            return np.eye(4)
        self.transforms.listen()
        try:
            poses: np.ndarray = self.transforms.tree.lookup_many(self.scan_frame, frame_id, at,
                                                                 max_gap)
        except MissingTransform as error:
            self.apart = not error.late
            raise
        self.apart = False
        return poses[0]

    def _look_further(self, stamp: int, known: bool) -> None:
        """With auto: TF where no odometry comes, and KISS-ICP where TF says nothing either."""
        if self.source in ("odometry", "tf") or known:
            self.without_ns = None
            return
        self.transforms.listen()
        if self.without_ns is None or stamp < self.without_ns:
            self.without_ns = stamp
        if stamp - self.without_ns >= GRACE_NS and self.icp is None and has_odometry():
            self._take_scans()

    def _take_scans(self) -> None:
        self.icp = Odometry()
        if not self.clouds:
            self.node.input("points", CLOUD, self._on_cloud)

    def _on_cloud(self, msg: Any) -> None:
        if not self._by_scans():
            return
        xyz = to_frame(msg)[0].xyz
        if not len(xyz):
            raise InputError("the cloud has no usable point, so the sensor's motion is not known")
        self._register(msg.header, xyz)

    def _register(self, header: Any, xyz: np.ndarray) -> None:
        stamp_ns = to_ns(header.stamp)
        if self.scan_ns - JUMP_NS <= stamp_ns <= self.scan_ns:
            return  # once more, or late; the tracker leaves it out, too, and says so
        gap = (stamp_ns - self.scan_ns) / SECOND
        if not 0 < gap <= 2 * self.params().max_gap:  # a map of another place, or of another time
            self.icp, self.scans, self.begun = Odometry(), TransformTree(), self.begun + 1
        self.scan_ns, self.scan_frame = stamp_ns, header.frame_id.lstrip("/")
        assert self.icp is not None  # made by the first scan
        begin = thread_time()
        pose = self.icp(xyz)
        self.icp_ms.append((thread_time() - begin) * 1e3)
        self.node.counts[ICP_MS] = f"{np.median(self.icp_ms):.1f}"
        self.scans.set(START, SCAN, stamp_ns, pose[:3, 3],
                       Rotation.from_matrix(pose[:3, :3]).as_quat())
        self.node.counts["last_pose_ns"] = stamp_ns
