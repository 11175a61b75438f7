"""What the looks at a drive say of each object that was followed through it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logit

from lidar_perception.adapting.looking import LEAST as SCORED
from lidar_perception.adapting.looking import SOURCES, FrameLook
from lidar_perception.robot.poses import moved_boxes
from lidar_perception.tracking.follow import Hit, followed
from lidar_perception.types import CLASSES

LEAST, MOST = 0.01, 0.99  # probabilities: no look is certain


@dataclass(frozen=True)
class Followed:
    """An object with n detections. frames (n,) int of the drive, rising;
    boxes (n, 7) in the drive's fixed frame; class_id; scores (n,) and by source what each says
    (n,), NaN where it is silent; counts (n,) points, tops (n,) metres; places (n, 2) x y in
    the sensor's frame; directions (n,) rad, from the sensor to it, in the fixed frame; seconds (n,)
    of the drive."""

    frames: np.ndarray
    boxes: np.ndarray
    class_id: int
    scores: np.ndarray
    sources: dict[str, np.ndarray]
    counts: np.ndarray
    tops: np.ndarray
    places: np.ndarray
    directions: np.ndarray
    seconds: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def score(self) -> float:
        """0..1: the mean of the detections' log-odds, as a probability."""
        return _mean(self.scores)

    @property
    def said(self) -> dict[str, float]:
        """By source the same, of the sources that say something."""
        return {name: _mean(own[np.isfinite(own)]) for name, own in self.sources.items()
                if np.isfinite(own).any()}

    @property
    def share(self) -> float:
        """0..1: of the frames from its first to its last, those in which it was detected."""
        return len(self) / float(self.frames[-1] - self.frames[0] + 1)

    @property
    def lasting(self) -> float:
        """As score, over all frames from its first to its last: where it was not detected, it is
        as good as nothing."""
        missed = np.full(int(self.frames[-1] - self.frames[0]) + 1 - len(self), SCORED / 2)
        return _mean(np.concatenate([self.scores, missed]))

    @property
    def ranges(self) -> np.ndarray:
        """(n,) metres from the sensor."""
        return np.hypot(*self.places.T)

    @property
    def way(self) -> float:
        """Metres over the ground between the mean places of its first and last third."""
        part = max(1, len(self) // 3)
        return float(np.hypot(*(self.boxes[-part:, :2].mean(axis=0)
                                - self.boxes[:part, :2].mean(axis=0))))

    @property
    def scatter(self) -> float:
        """Metres: how far its places are from its straight and even way, root mean square."""
        t = self.seconds - self.seconds.mean()
        moved = self.boxes[:, :2] - self.boxes[:, :2].mean(axis=0)
        speed = (t @ moved) / max(float(t @ t), 1e-9)
        return float(np.sqrt(((moved - t[:, None] * speed) ** 2).sum(axis=1).mean()))

    @property
    def views(self) -> tuple[float, float]:
        """How much the views of it differ: metres of range, and degrees of the direction in which
        the sensor sees it over the ground."""
        return float(np.ptp(self.ranges)), float(np.degrees(np.ptp(np.unwrap(self.directions))))


def tracks_of(looks: Sequence[FrameLook], stamps_ns: Sequence[int]) -> list[Followed]:
    """The objects of a drive, of which all frames were looked at."""
    start = looks[0].pose
    poses = [np.linalg.inv(start) @ look.pose for look in looks]
    found = followed([look.detections for look in looks], stamps_ns, poses)
    return [_joined(one, looks, stamps_ns, poses) for one in found]


def _joined(one: list[Hit], looks: Sequence[FrameLook], stamps_ns: Sequence[int],
            poses: Sequence[np.ndarray]) -> Followed:
    frames = np.array([frame for frame, _ in one])
    parts = [looks[frame].detections[k:k + 1] for frame, k in one]
    fixed = np.concatenate([moved_boxes(part.boxes, poses[frame])
                            for part, (frame, _) in zip(parts, one)])
    scores = np.concatenate([part.scores for part in parts]).astype(np.float64)
    votes = np.bincount(np.concatenate([part.class_ids for part in parts]), weights=scores,
                        minlength=len(CLASSES))
    sight = fixed[:, :2] - np.array([poses[frame][:2, 3] for frame in frames])
    return Followed(
        frames, fixed, int(votes.argmax()), scores,
        {name: np.concatenate([part.sources[name] for part in parts]) for name in SOURCES},
        np.array([looks[frame].counts[k] for frame, k in one]),
        np.array([looks[frame].tops[k] for frame, k in one]),
        np.concatenate([part.boxes[:, :2] for part in parts]).astype(np.float64),
        np.arctan2(sight[:, 1], sight[:, 0]),
        np.array([(stamps_ns[frame] - stamps_ns[0]) / 1e9 for frame in frames]))


def _mean(probabilities: np.ndarray) -> float:
    odds = logit(np.clip(probabilities.astype(np.float64), LEAST, MOST))
    return float(1 / (1 + np.exp(-odds.mean())))
