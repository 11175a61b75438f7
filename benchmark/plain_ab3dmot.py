"""Plain implementation of AB3DMOT (Weng et al., IROS 2020), to compare our tracker with.

It has one constant-velocity Kalman filter per box and Hungarian assignment by centre distance. Tracks
start after 3 hits and end after 2 misses. Classes are tracked separately. Covariances and gates are
the authors' values for KITTI. It shares only the types with our code.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from lidar_perception.types import CLASSES, Detections

MIN_HITS, MAX_AGE = 3, 2
GATES = {"Car": 6.0, "Pedestrian": 1.0, "Cyclist": 6.0}
OTHER_GATE = 6.0

# The state is x y z yaw l w h, and the change of x y z per frame.
TRANSITION = np.eye(10)
TRANSITION[:3, 7:] = np.eye(3)
MEASUREMENT = np.eye(7, 10)
INITIAL_COVARIANCE = np.diag([10.0] * 7 + [10_000.0] * 3)
PROCESS_NOISE = np.diag([1.0] * 7 + [0.01] * 3)


@dataclass
class _Track:
    number: int
    state: np.ndarray
    score: float
    covariance: np.ndarray = field(default_factory=lambda: INITIAL_COVARIANCE.copy())
    hits: int = 1
    age: int = 0

    def predict(self) -> None:
        self.state = TRANSITION @ self.state
        self.covariance = TRANSITION @ self.covariance @ TRANSITION.T + PROCESS_NOISE
        self.age += 1

    def update(self, measurement: np.ndarray, score: float) -> None:
        yaw_change = (measurement[3] - self.state[3] + np.pi) % (2 * np.pi) - np.pi
        if abs(yaw_change) > np.pi / 2:  # the detector confused front and back
            self.state[3] += np.pi
            yaw_change -= np.sign(yaw_change) * np.pi
        difference = measurement - self.state[:7]
        difference[3] = yaw_change
        gain = (
            self.covariance @ MEASUREMENT.T @ np.linalg.inv(MEASUREMENT @ self.covariance @ MEASUREMENT.T + np.eye(7))
        )
        self.state = self.state + gain @ difference
        self.covariance = (np.eye(10) - gain @ MEASUREMENT) @ self.covariance
        self.score, self.hits, self.age = score, self.hits + 1, 0


class PlainAb3dmot:
    """Tracker. A call with detections and the sensor pose (4, 4) returns ids (K,) and Detections."""

    def __init__(self) -> None:
        self.tracks: dict[int, list[_Track]] = {}
        self.frames = 0
        self.next = 1

    def __call__(self, detections: Detections, pose: np.ndarray | None = None) -> tuple[np.ndarray, Detections]:
        pose = np.eye(4) if pose is None else pose
        self.frames += 1
        ids, boxes, classes, scores = [], [], [], []
        for class_id in sorted({*self.tracks, *detections.class_ids.tolist()}):
            for track in self._track_class(class_id, detections[detections.class_ids == class_id], pose):
                ids.append(track.number)
                boxes.append(_transform(track.state[[0, 1, 2, 4, 5, 6, 3]], np.linalg.inv(pose)))
                classes.append(class_id)
                scores.append(track.score)
        return np.array(ids, int), Detections.of(np.reshape(boxes, (-1, 7)), np.array(classes, int), np.array(scores))

    def _track_class(self, class_id: int, detections: Detections, pose: np.ndarray) -> list[_Track]:
        tracks = self.tracks.setdefault(class_id, [])
        boxes = (_transform(box.astype(float), pose) for box in detections.boxes)
        measurements = [box[[0, 1, 2, 6, 3, 4, 5]] for box in boxes]
        for track in tracks:
            track.predict()
        gate, unassigned_indices = GATES.get(CLASSES[class_id], OTHER_GATE), set(range(len(measurements)))
        if tracks and measurements:
            distance = np.array([[np.linalg.norm(m[:3] - t.state[:3]) for t in tracks] for m in measurements])
            for i, j in zip(*linear_sum_assignment(distance)):
                if distance[i, j] <= gate:
                    tracks[j].update(measurements[i], float(detections.scores[i]))
                    unassigned_indices.discard(int(i))
        for i in sorted(unassigned_indices):
            tracks.append(_Track(self.next, np.append(measurements[i], np.zeros(3)), float(detections.scores[i])))
            self.next += 1
        self.tracks[class_id] = [t for t in tracks if t.age < MAX_AGE]
        return [t for t in self.tracks[class_id] if t.hits >= MIN_HITS or self.frames <= MIN_HITS]


def _transform(box: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Transform a box (7,) by a pose (4, 4)."""
    forward = pose[:3, :3] @ [np.cos(box[6]), np.sin(box[6]), 0.0]
    return np.concatenate([pose[:3, :3] @ box[:3] + pose[:3, 3], box[3:6], [np.arctan2(forward[1], forward[0])]])
