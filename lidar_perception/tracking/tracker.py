"""Multi-object tracker with Kalman filters, two-stage assignment and existence probabilities.

Tracks are estimated in a fixed frame. The same frames always give the same tracks.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.classes import CAR
from lidar_perception.robot.poses import transform_boxes
from lidar_perception.tracking import motion
from lidar_perception.tracking.ego import Ego, advance_ego, is_jump, is_valid_pose
from lidar_perception.tracking.existence import to_probability
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.tracking.state import States, Tracks
from lidar_perception.tracking.step import (
    compute_probabilities,
    find_pedestrians,
    match,
    predict,
    prune,
    start_tracks,
    update,
)
from lidar_perception.types import CLASSES, MAX_RANGE, Detections, InputError

# Minimum probability of motion of a pedestrian with a known heading. Detectors do not measure the heading of people,
# so it is known only from their motion over ground.
MIN_WALKING_PROBABILITY = 0.5


class Tracker:
    """Multi-object tracker: tracker(detections, stamp_ns, pose) -> Tracks.

    Attributes:
        params: Parameters, which may be replaced between calls.
        problem: Description of a problem with the last frame, or None.
        frame_used: False if the last frame was ignored.
        started_count: Number of tracks started so far.
        ended_count: Number of tracks ended so far.
    """

    def __init__(self, params: TrackingParams = TrackingParams()) -> None:
        self.params = params
        self.problem: str | None = None
        self.frame_used = False
        self.started_count = self.ended_count = 0
        self._states, self._ego = States.none(), Ego.unknown()
        self._last_stamp: int | None = None
        self._late_stamp: int | None = None  # stamp of the last frame if it was late
        self._next_id = 1

    @property
    def alive_count(self) -> int:
        """Number of tracks, including those that are not published yet."""
        return len(self._states)

    @property
    def pose(self) -> np.ndarray:
        """Pose (4, 4) of the sensor in the fixed frame at the last frame."""
        return self._ego.pose

    def reset(self) -> None:
        """End all tracks; later tracks get new ids."""
        self.ended_count += len(self._states)
        self._states, self._ego, self._last_stamp = States.none(), Ego.unknown(), None

    def __call__(self, detections: Detections, stamp_ns: int = 0, pose: np.ndarray | None = None) -> Tracks:
        """Update the tracks with one frame and return them.

        Boxes that are not finite or have no size are ignored. A frame is ignored if its stamp equals
        that of the previous frame or is slightly older. If two such older frames follow each other
        in order, time is assumed to have restarted. A restart, or a jump of time or of the sensor's
        pose, ends all tracks.

        Args:
            detections: Boxes in the sensor's frame.
            stamp_ns: Time of the frame, or 0 if it has none.
            pose: (4, 4) pose of the sensor in a fixed frame, or None if unknown.

        Returns:
            The tracks in the sensor's frame.

        Raises:
            InputError: `detections` is not a Detections object.
        """
        if not isinstance(detections, Detections):
            raise InputError(
                f"a tracker needs Detections, not {type(detections).__name__}; pass "
                "detector(cloud).detections, or Detections.of(boxes, class_ids, "
                "scores) with boxes (K, 7)"
            )
        self.problem = None
        seconds = self._compute_elapsed(int(stamp_ns))
        self.frame_used = seconds is not None
        if seconds is None:
            return self._make_tracks(np.zeros(len(self._states), bool))
        self._update_ego(pose, seconds)
        boxes, class_ids, scores = self._select_valid(detections)
        boxes = transform_boxes(boxes, self._ego.pose)
        states = predict(self._states, seconds, self.params)
        i, j = match(states, boxes, class_ids, scores, self.params, seconds)
        states = update(states, i, boxes[j], class_ids[j], scores[j], self.params, self._ego.has_pose, seconds)
        is_unmatched = np.ones(len(boxes), bool)
        is_unmatched[j] = False
        new_detections = np.flatnonzero(is_unmatched & (scores >= self.params.association.strong))
        old_count = len(states)
        states = states.concatenate(
            start_tracks(
                self._next_id, boxes[new_detections], class_ids[new_detections], scores[new_detections], self.params
            )
        )
        self._next_id += len(new_detections)
        is_seen = np.zeros(len(states), bool)
        is_seen[i], is_seen[old_count:] = True, True
        seen_ids = set(states.ids[is_seen].tolist())
        remaining_states = prune(states, self.params, self._ego.has_pose)
        self.started_count += len(new_detections)
        self.ended_count += len(states) - len(remaining_states)
        self._states = remaining_states
        return self._make_tracks(np.array([i in seen_ids for i in remaining_states.ids.tolist()], bool))

    def predict(self, stamp_ns: int) -> Tracks:
        """Predict the tracks at stamp_ns, for a lost or late frame, without changing the tracker.

        The sensor is assumed to keep its velocity. Returns the tracks in its frame.
        """
        self.problem = None
        seconds = 0.0 if self._last_stamp is None else (int(stamp_ns) - self._last_stamp) / 1e9
        seconds = min(max(seconds, 0.0), self.params.max_gap)
        ego = advance_ego(self._ego, None, seconds, self.params.max_ego_gap)
        states = predict(self._states, seconds, self.params)
        return _to_sensor_frame(states, ego, np.zeros(len(states), bool), self.params)

    def _compute_elapsed(self, stamp: int) -> float | None:
        """Return the seconds since the last frame, or None if the frame must be ignored."""
        if stamp == 0:
            self.problem = f"the frames have no stamps: assuming {self.params.period:g} s per frame"
            return self.params.period
        last_stamp, self._last_stamp = self._last_stamp, stamp
        late_stamp, self._late_stamp = self._late_stamp, None
        if last_stamp is None:
            return self.params.period
        seconds = (stamp - last_stamp) / 1e9
        if seconds == 0:
            self.problem = "a frame has the same stamp as the previous one and is ignored"
            return None
        has_restarted = late_stamp is not None and stamp > late_stamp  # for example a short bag in a loop
        if seconds < 0 and -seconds <= self.params.max_gap and not has_restarted:
            self._last_stamp, self._late_stamp = last_stamp, stamp
            self.problem = f"a frame is {-seconds:.2f} s older than the previous one and is ignored"
            return None
        if seconds < 0 or seconds > self.params.max_gap:
            self.reset()
            self._last_stamp = stamp
            self.problem = f"time jumped by {seconds:.2f} s: all tracks ended"
            return self.params.period
        return seconds

    def _update_ego(self, pose: np.ndarray | None, seconds: float) -> None:
        valid_pose = pose if is_valid_pose(pose) else None
        if (
            valid_pose is not None
            and len(self._states)
            and (not self._ego.has_pose or is_jump(self._ego, valid_pose, seconds))
        ):
            stamp, had_pose = self._last_stamp, self._ego.has_pose
            self.reset()
            self._last_stamp = stamp
            self.problem = (
                "the sensor's pose jumped: all tracks ended"
                if had_pose
                else "the first pose arrived: all tracks ended, and new ones start in the fixed frame"
            )
        if valid_pose is None and (pose is not None or self._ego.has_pose):
            self.problem = (
                "the pose is missing or not rigid: the sensor is assumed to keep its "
                f"velocity for {self.params.max_ego_gap:g} s and then to stop; check that "
                "odometry or TF is published often enough"
            )
        self._ego = advance_ego(self._ego, valid_pose, seconds, self.params.max_ego_gap)

    def _select_valid(self, detections: Detections) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the boxes (K, 7), class ids (K,) and scores (K,) of the valid detections.

        At most max_detections are returned, those with the highest scores.
        """
        boxes, scores = detections.boxes.astype(np.float64), detections.scores.astype(np.float64)
        with np.errstate(invalid="ignore"):
            is_valid = (
                np.isfinite(boxes).all(axis=1)
                & np.isfinite(scores)
                & (boxes[:, 3:6] > 0).all(axis=1)
                & (np.abs(boxes[:, :6]) <= MAX_RANGE).all(axis=1)
                & (detections.class_ids >= 0)
                & (detections.class_ids < len(CLASSES))
            )
        if not is_valid.all():
            self.problem = (
                f"{(~is_valid).sum()} of {len(is_valid)} detections are ignored: they are not finite, "
                f"have no size, or are more than {MAX_RANGE / 1e3:g} km from the origin "
                "of their frame; publish them in a local frame"
            )
        indices = np.flatnonzero(is_valid & (scores >= self.params.min_score))
        if len(indices) > self.params.max_detections:
            self.problem = (
                f"the frame has {len(indices)} detections; only the {self.params.max_detections} with the highest "
                "scores are used"
            )
            indices = np.sort(indices[np.argsort(-scores[indices], kind="stable")[: self.params.max_detections]])
        return boxes[indices], detections.class_ids[indices], np.clip(scores[indices], 0.0, 1.0)

    def _make_tracks(self, seen: np.ndarray) -> Tracks:
        return _to_sensor_frame(self._states, self._ego, seen, self.params)


def _to_sensor_frame(states: States, ego: Ego, seen: np.ndarray, params: TrackingParams) -> Tracks:
    """Return the tracks that are probable enough to publish, in the sensor's frame."""
    scores = compute_probabilities(states, params, ego.has_pose)
    indices = np.flatnonzero(
        (scores >= params.report) & (seen | (to_probability(states.presence) >= params.report_unseen))
    )
    published_states, to_sensor = states.take(indices), np.linalg.inv(ego.pose)
    cos, sin = (to_sensor[:2, 0] / max(np.hypot(*to_sensor[:2, 0]), 1e-9)).tolist()
    side = -1.0 if to_sensor[2, 2] < 0 else 1.0  # -1 for an upside-down sensor
    covariances = motion.rotate_covariances(published_states.covariances, cos, sin, side)
    is_walking = (published_states.moving >= MIN_WALKING_PROBABILITY) & ego.has_pose
    covariances = motion.forget_headings(covariances, find_pedestrians(published_states) & ~is_walking)
    velocities = published_states.means[:, 2:4] @ np.array([[cos, sin], [-side * sin, side * cos]])
    detections = Detections.of(
        transform_boxes(published_states.to_boxes(), to_sensor), published_states.class_ids, scores[indices]
    )
    return Tracks(
        published_states.ids,
        detections,
        velocities,
        published_states.moving,
        covariances,
        side * published_states.means[:, 5],
        published_states.height_variances,
        seen[indices],
        published_states.ages,
    )


def warm_up() -> None:
    """Track two overlapping boxes over two frames to trigger JIT compilation."""
    boxes = np.array([[10, 0, -1, 4, 2, 1.5, 0], [10.5, 0, -1, 4, 2, 1.5, 0]], np.float32)
    tracker = Tracker()
    for stamp_ns in (1, 10**8):
        tracker(Detections.of(boxes, CAR, np.full(2, 0.9)), stamp_ns)
