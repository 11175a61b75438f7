"""The ways of tracks."""

from __future__ import annotations

from collections import deque

import numpy as np

from lidar_perception.tracking.state import Tracks

TRAIL_POINTS = 20  # of one track


class Trails:
    """Where each track was lately."""

    def __init__(self) -> None:
        self._ways: dict[int, deque[tuple[int, np.ndarray]]] = {}

    def __call__(self, tracks: Tracks, pose: np.ndarray, stamp_ns: int,
                 seconds: float) -> list[np.ndarray]:
        """The last so many seconds of each of K tracks, K times (N, 3) float64, N from 1 to
        TRAIL_POINTS, so far apart in time that these reach, oldest first and last its place now,
        in the frame whose pose (4, 4) this is, that of the tracks. A track that is left out once
        begins anew."""
        length = int(seconds * 1e9)
        oldest, apart = stamp_ns - length, length // (TRAIL_POINTS + 1)  # + 1: frames are not even
        centres = tracks.detections.boxes[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        before, self._ways = self._ways, {}
        for number, centre in zip(tracks.ids.tolist(), centres):
            way = before.get(number) or deque(maxlen=TRAIL_POINTS)
            while way and way[0][0] < oldest:
                way.popleft()
            if len(way) > 1 and way[-1][0] - way[-2][0] < apart:
                way.pop()  # the last place, too near to the one before to stay
            way.append((stamp_ns, centre))
            self._ways[number] = way
        back = np.linalg.inv(pose)
        return [np.array([place for _, place in way]) @ back[:3, :3].T + back[:3, 3]
                for way in self._ways.values()]
