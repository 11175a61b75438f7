"""Trails of tracks: their positions in the recent past."""

from __future__ import annotations

from collections import deque

import numpy as np

from lidar_perception.tracking.state import Tracks

TRAIL_POINTS = 20  # maximum number of positions in a trail


class Trails:
    """Recorder of the trail of each track."""

    def __init__(self) -> None:
        self._trails: dict[int, deque[tuple[int, np.ndarray]]] = {}

    def __call__(self, tracks: Tracks, pose: np.ndarray, stamp_ns: int, seconds: float) -> list[np.ndarray]:
        """Return the trail of each of K tracks over the last `seconds`.

        A trail is an array (N, 3) float64 of positions, oldest first. It is thinned to at most
        TRAIL_POINTS positions that cover the full time. If a track is missing in one call, its next
        trail starts from scratch.

        Args:
            pose: (4, 4) pose of the sensor, in whose frame tracks and trails are given, in a fixed
                frame.
            stamp_ns: Time of the tracks.
            seconds: Duration of a trail.
        """
        length = int(seconds * 1e9)
        oldest_stamp, min_gap = stamp_ns - length, length // (TRAIL_POINTS + 1)  # + 1 allows for uneven frame times
        centres = tracks.detections.boxes[:, :3].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        previous_trails, self._trails = self._trails, {}
        for track_id, centre in zip(tracks.ids.tolist(), centres):
            trail = previous_trails.get(track_id) or deque(maxlen=TRAIL_POINTS)
            while trail and trail[0][0] < oldest_stamp:
                trail.popleft()
            if len(trail) > 1 and trail[-1][0] - trail[-2][0] < min_gap:
                trail.pop()  # drop the last position if it came too soon after the previous one
            trail.append((stamp_ns, centre))
            self._trails[track_id] = trail
        from_fixed_frame = np.linalg.inv(pose)
        return [
            np.array([position for _, position in trail]) @ from_fixed_frame[:3, :3].T + from_fixed_frame[:3, 3]
            for trail in self._trails.values()
        ]
