"""Pedestrian scores by centre distance (paper A, Section 3.8), for detections with a score.

F1 depends on the score threshold, and a detector returns many detections with a low score.
Therefore, F1 is reported for all detections and at the best threshold, which is an upper bound.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.scoring.centres.matching import Score, match_centres
from lidar_perception.scoring.intervals import compute_interval, group_frames


@dataclass
class CentreScores:
    """Detections and labels of the frames with at least one pedestrian.

    Attributes:
        frames: Labelled boxes (M, 7), detected boxes (K, 7) and their scores (K,) in descending
            order, for each frame.
        names: Name of each frame.
    """

    frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def update(self, truth: np.ndarray, boxes: np.ndarray, scores: np.ndarray, name: str = "") -> None:
        """Add one frame. Frames without labels are ignored, as in the paper."""
        if len(truth):
            order = np.lexsort([*boxes.T, -scores])
            self.frames.append((truth, boxes[order], scores[order]))
            self.names.append(name)

    def find_best_score(self) -> float | None:
        """Return the score threshold with the best F1 (the highest one in a tie), None without detections."""
        score_parts, hit_parts = [np.zeros(0)], [np.zeros(0, int)]
        for truth, boxes, frame_scores in self.frames:
            hit_counts = [len(match_centres(boxes[:n], truth)[0]) for n in range(len(boxes) + 1)]
            score_parts.append(frame_scores)
            hit_parts.append(np.diff(hit_counts))
        scores, hits = np.concatenate(score_parts), np.concatenate(hit_parts)
        if len(scores) == 0:
            return None
        order = np.argsort(-scores, kind="stable")
        scores, hits = scores[order], np.cumsum(hits[order])
        label_count = sum(len(truth) for truth, _, _ in self.frames)
        f1 = 2 * hits / (np.arange(1, len(hits) + 1) + label_count)
        is_last_of_score = np.append(
            scores[1:] < scores[:-1], True
        )  # detections with equal scores are kept or dropped together
        return float(scores[is_last_of_score][np.argmax(f1[is_last_of_score])])

    def make_rows(self, min_score: float = -np.inf) -> dict[str, dict]:
        """Return the rows of matching.Score for detections with a score of at least min_score."""
        total = Score()
        for truth, boxes, scores in self.frames:
            total.update(boxes[scores >= min_score], truth)
        return total.make_rows()

    def compute_f1_interval(self, min_score: float, count: int, sequential: bool = False) -> list[float] | None:
        """Compute the bootstrap interval [low, high] of F1 in percent, see intervals.py.

        Args:
            min_score: Minimum score of a detection.
            count: Number of bootstrap draws.
            sequential: See intervals.group_frames.
        """
        detections = [boxes[scores >= min_score] for _, boxes, scores in self.frames]
        counts = np.array(
            [
                [len(match_centres(boxes, truth)[0]), len(boxes), len(truth)]
                for boxes, (truth, _, _) in zip(detections, self.frames)
            ]
        ).reshape(-1, 3)

        def f1(frames: np.ndarray) -> float:
            hits, boxes, labels = counts[frames].sum(axis=0)
            return 200 * hits / (boxes + labels)

        return compute_interval(f1, group_frames(self.names, sequential), count)

    def compute(self) -> dict:
        """Return the content of the JSON file."""
        best = self.find_best_score()
        return {
            "frames": len(self.frames),
            "ground_truth": sum(len(t) for t, _, _ in self.frames),
            "of_all": self.make_rows(),
            "best_score": best,
            "at_best_score": self.make_rows() if best is None else self.make_rows(best),
        }
