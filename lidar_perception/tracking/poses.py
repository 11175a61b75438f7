"""Where the sensor was: poses with stamps, what lies between them, and the ways of tracks."""

from __future__ import annotations

from bisect import bisect_left
from collections import deque

import numpy as np
from scipy.spatial.transform import Rotation

from lidar_perception.tracking.ego import usable
from lidar_perception.tracking.state import Tracks

CAPACITY = 2000    # poses; 20 s of an odometry at 100 Hz
TRAIL_POINTS = 20  # of one track


class PoseHistory:
    """The last poses (4, 4) of one frame in another, by their stamps, in whatever order they come.
    A stamp that is max_jump_ns older than the newest begins anew, as a bag does that is played
    again."""

    def __init__(self, max_jump_ns: int = 10**9) -> None:
        self.max_jump_ns = max_jump_ns
        self._stamps: list[int] = []
        self._poses: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def newest(self) -> int:
        """The stamp of the newest, 0 for none."""
        return self._stamps[-1] if self._stamps else 0

    def add(self, stamp_ns: int, pose: np.ndarray) -> bool:
        """False for what is no pose, which is left out."""
        if not usable(pose):
            return False
        if self._stamps and stamp_ns < self._stamps[-1] - self.max_jump_ns:
            self._stamps.clear()
            self._poses.clear()
        i = bisect_left(self._stamps, stamp_ns)
        if i < len(self._stamps) and self._stamps[i] == stamp_ns:
            self._poses[i] = pose
            return True
        self._stamps.insert(i, stamp_ns)
        self._poses.insert(i, pose)
        if len(self._stamps) > CAPACITY:
            del self._stamps[:CAPACITY // 2], self._poses[:CAPACITY // 2]
        return True

    def at(self, stamp_ns: int, max_gap: float) -> np.ndarray | None:
        """The pose (4, 4) at a stamp: between its neighbours, or after the last one as the last two
        go on; None where they are more than max_gap seconds away, and before the first."""
        stamps, last = self._stamps, len(self._stamps) - 1
        i = bisect_left(stamps, stamp_ns)
        if i <= last and stamps[i] == stamp_ns:
            return self._poses[i]
        if i == 0 or last == 0:
            return None
        i = min(i, last)
        first, second = stamps[i - 1], stamps[i]
        if max(second - first, stamp_ns - second) > max_gap * 1e9:
            return None
        return between(self._poses[i - 1], self._poses[i], (stamp_ns - first) / (second - first))


def between(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """The pose (4, 4) at a share of the way from first (0) to second (1), or beyond: a straight
    line, and the shortest turn at an even rate."""
    pose = np.eye(4)
    turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).as_rotvec()
    pose[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    pose[:3, 3] = first[:3, 3] + share * (second[:3, 3] - first[:3, 3])
    return pose


class Trails:
    """Where each track was lately."""

    def __init__(self) -> None:
        self._ways: dict[int, deque[tuple[int, np.ndarray]]] = {}

    def __call__(self, tracks: Tracks, pose: np.ndarray, stamp_ns: int,
                 seconds: float) -> list[np.ndarray]:
        """The last so many seconds of each of K tracks, K times (N, 3) float64, N from 1 to
        TRAIL_POINTS, oldest first and last its place now, in the frame whose pose (4, 4) this is,
        that of the tracks. A track that is left out once begins anew."""
        oldest = stamp_ns - int(seconds * 1e9)
        centres = tracks.detections.boxes[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        before, self._ways = self._ways, {}
        for number, centre in zip(tracks.ids.tolist(), centres):
            way = before.get(number) or deque(maxlen=TRAIL_POINTS)
            while way and way[0][0] < oldest:
                way.popleft()
            way.append((stamp_ns, centre))
            self._ways[number] = way
        back = np.linalg.inv(pose)
        return [np.array([place for _, place in way]) @ back[:3, :3].T + back[:3, 3]
                for way in self._ways.values()]
