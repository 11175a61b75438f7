"""The tracker: one small state, fed frame by frame.

Kalman filters over a fixed frame, assignment in two rounds by score, and birth and death by
evidence. The same frames give the same tracks.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.robot.poses import transform_boxes
from lidar_perception.tracking import motion
from lidar_perception.tracking.ego import Ego, jumped, next_ego, usable
from lidar_perception.tracking.existence import probability
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.state import States, Tracks
from lidar_perception.tracking.step import alive, born, matched, predicted, probabilities, updated
from lidar_perception.types import CLASSES, MAX_RANGE, Detections, InputError


class Tracker:
    """tracker(detections, stamp_ns, pose) -> Tracks.

    params may be replaced at any time. After each call problem says what was wrong with the frame,
    or is None, and taken whether the frame took part; born and ended count tracks since the start,
    and alive those there are.
    """

    def __init__(self, params: TrackingParams = TrackingParams()) -> None:
        self.params = params
        self.problem: str | None = None
        self.taken = False
        self.born = self.ended = 0
        self._states, self._ego = States.none(), Ego.unknown()
        self._stamp: int | None = None
        self._late: int | None = None  # the stamp of the last frame, if that was late
        self._next = 1

    @property
    def alive(self) -> int:
        """How many tracks there are, those that are not reported too."""
        return len(self._states)

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) the last frame in the fixed one."""
        return self._ego.pose

    def reset(self) -> None:
        """End all tracks; ids go on."""
        self.ended += len(self._states)
        self._states, self._ego, self._stamp = States.none(), Ego.unknown(), None

    def __call__(self, detections: Detections, stamp_ns: int = 0,
                 pose: np.ndarray | None = None) -> Tracks:
        """The tracks after the frame of stamp_ns, 0 where it has none, whose detections these are,
        in the sensor's frame; pose (4, 4) of the sensor in a fixed frame, None where unknown.

        What cannot be used does no harm: boxes that are not finite, or without a size, are left
        out; a frame of the same stamp, or a little late, changes nothing; time that jumps, also
        back by a little and on from there, and a sensor that does, ends all tracks.

        InputError for anything else than Detections.
        """
        if not isinstance(detections, Detections):
            raise InputError(f"a tracker takes Detections, not {type(detections).__name__}; give "
                             "detector(cloud).detections, or Detections.of(boxes, class_ids, "
                             "scores) with boxes (K, 7)")
        self.problem = None
        seconds = self._seconds(int(stamp_ns))
        self.taken = seconds is not None
        if seconds is None:
            return self._reported(np.zeros(len(self._states), bool))
        self._move_ego(pose, seconds)
        boxes, class_ids, scores = self._usable(detections)
        boxes = transform_boxes(boxes, self._ego.pose)
        states = predicted(self._states, seconds, self.params)
        i, j = matched(states, boxes, class_ids, scores, self.params, seconds)
        states = updated(states, i, boxes[j], class_ids[j], scores[j], self.params,
                         self._ego.known, seconds)
        free = np.ones(len(boxes), bool)
        free[j] = False
        start = np.flatnonzero(free & (scores >= self.params.association.strong))
        before = len(states)
        states = states.followed_by(born(self._next, boxes[start], class_ids[start],
                                         scores[start], self.params))
        self._next += len(start)
        seen = np.zeros(len(states), bool)
        seen[i], seen[before:] = True, True
        hit = set(states.ids[seen].tolist())
        kept = alive(states, self.params, self._ego.known)
        self.born += len(start)
        self.ended += len(states) - len(kept)
        self._states = kept
        return self._reported(np.array([i in hit for i in kept.ids.tolist()], bool))

    def at(self, stamp_ns: int) -> Tracks:
        """The tracks predicted to a stamp after the last frame's, which changes nothing, in the
        frame of the sensor as it is taken to have moved on; for a frame that is lost or late."""
        self.problem = None
        seconds = 0.0 if self._stamp is None else (int(stamp_ns) - self._stamp) / 1e9
        seconds = min(max(seconds, 0.0), self.params.max_gap)
        ego = next_ego(self._ego, None, seconds, self.params.max_ego_gap)
        states = predicted(self._states, seconds, self.params)
        return _in_sensor_frame(states, ego, np.zeros(len(states), bool), self.params)

    def _seconds(self, stamp: int) -> float | None:
        """Since the last frame; None for a frame to leave out."""
        if stamp == 0:
            self.problem = "the frames have no stamps: tracks take one frame each period"
            return self.params.period
        last, self._stamp = self._stamp, stamp
        late, self._late = self._late, None
        if last is None:
            return self.params.period
        seconds = (stamp - last) / 1e9
        if seconds == 0:
            self.problem = "a frame has the stamp of the one before and is left out"
            return None
        goes_on = late is not None and stamp > late  # as of a short bag that is played again
        if seconds < 0 and -seconds <= self.params.max_gap and not goes_on:
            self._stamp, self._late = last, stamp
            self.problem = f"a frame is {-seconds:.2f} s older than the last one and is left out"
            return None
        if seconds < 0 or seconds > self.params.max_gap:
            self.reset()
            self._stamp = stamp
            self.problem = f"time jumped by {seconds:.2f} s: all tracks ended"
            return self.params.period
        return seconds

    def _move_ego(self, pose: np.ndarray | None, seconds: float) -> None:
        given = pose if usable(pose) else None
        if given is not None and len(self._states) and (
                not self._ego.known or jumped(self._ego, given, seconds)):
            stamp, known = self._stamp, self._ego.known
            self.reset()
            self._stamp = stamp
            self.problem = ("the sensor's pose jumped: all tracks ended" if known else
                            "poses began: all tracks ended, and go on in the fixed frame")
        if given is None and (pose is not None or self._ego.known):
            self.problem = ("the pose is missing or not rigid: the sensor is taken to move on as "
                            f"before, after {self.params.max_ego_gap:g} s to stand; are odometry or"
                            " TF running, and often enough?")
        self._ego = next_ego(self._ego, given, seconds, self.params.max_ego_gap)

    def _usable(self, detections: Detections) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Boxes (K, 7), class ids (K,), scores (K,), float64, the best max_detections."""
        boxes, scores = detections.boxes.astype(np.float64), detections.scores.astype(np.float64)
        with np.errstate(invalid="ignore"):
            good = (np.isfinite(boxes).all(axis=1) & np.isfinite(scores)
                    & (boxes[:, 3:6] > 0).all(axis=1)
                    & (np.abs(boxes[:, :6]) <= MAX_RANGE).all(axis=1)
                    & (detections.class_ids >= 0) & (detections.class_ids < len(CLASSES)))
        if not good.all():
            self.problem = (f"{(~good).sum()} of {len(good)} detections are no boxes (not finite, "
                            f"without a size, or beyond {MAX_RANGE / 1e3:g} km of their frame's "
                            "origin: give a frame nearby) and are left out")
        indices = np.flatnonzero(good & (scores >= self.params.min_score))
        if len(indices) > self.params.max_detections:
            self.problem = (f"{len(indices)} detections are too many; the best "
                            f"{self.params.max_detections} are taken")
            indices = np.sort(indices[np.argsort(-scores[indices], kind="stable")[
                :self.params.max_detections]])
        return boxes[indices], detections.class_ids[indices], np.clip(scores[indices], 0.0, 1.0)

    def _reported(self, seen: np.ndarray) -> Tracks:
        return _in_sensor_frame(self._states, self._ego, seen, self.params)


def _in_sensor_frame(states: States, ego: Ego, seen: np.ndarray,
                     params: TrackingParams) -> Tracks:
    """Those that are to be reported."""
    scores = probabilities(states, params, ego.known)
    indices = np.flatnonzero((scores >= params.report) & (
        seen | (probability(states.present) >= params.report_unseen)))
    chosen, back = states.take(indices), np.linalg.inv(ego.pose)
    cos, sin = (back[:2, 0] / max(np.hypot(*back[:2, 0]), 1e-9)).tolist()
    side = -1.0 if back[2, 2] < 0 else 1.0  # a sensor that hangs upside down sees from below
    covariances = motion.turned(chosen.covariances, cos, sin, side)
    velocities = chosen.means[:, 2:4] @ np.array([[cos, sin], [-side * sin, side * cos]])
    found = Detections.of(transform_boxes(chosen.boxes(), back), chosen.class_ids, scores[indices])
    return Tracks(chosen.ids, found, velocities, chosen.moving, covariances,
                  side * chosen.means[:, 5],
                  chosen.height_variances, seen[indices], chosen.ages)
