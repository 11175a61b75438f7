"""Pedestrians by centre distance (paper A, Section 3.8), for detections with a score.

F1 depends on the score threshold, and a detector returns many detections of low score. F1 is
therefore reported for all detections and at the best threshold, an upper bound on these frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.scoring.centres.matching import Score, match_centres
from lidar_perception.scoring.intervals import compute_interval, group_frames


@dataclass
class CentreScores:
    """Frames with at least one Pedestrian label, and their names.

    frames holds labelled boxes (M, 7), detected boxes (K, 7) and scores (K,), best first.
    """

    frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def update(self, truth: np.ndarray, boxes: np.ndarray, scores: np.ndarray, name: str = "") -> None:
        """Add one frame; ignore it if truth is empty, as in the paper."""
        if len(truth):
            order = np.lexsort([*boxes.T, -scores])
            self.frames.append((truth, boxes[order], scores[order]))
            self.names.append(name)

    def find_best_score(self) -> float | None:
        """Return the (highest) score threshold with the best F1, None without detections."""
        each_scores, each_hits = [np.zeros(0)], [np.zeros(0, int)]
        for truth, boxes, found_scores in self.frames:
            found = [len(match_centres(boxes[:n], truth)[0]) for n in range(len(boxes) + 1)]
            each_scores.append(found_scores)
            each_hits.append(np.diff(found))
        scores, hits = np.concatenate(each_scores), np.concatenate(each_hits)
        if len(scores) == 0:
            return None
        order = np.argsort(-scores, kind="stable")
        scores, hits = scores[order], np.cumsum(hits[order])
        true = sum(len(truth) for truth, _, _ in self.frames)
        f1 = 2 * hits / (np.arange(1, len(hits) + 1) + true)
        last = np.append(scores[1:] < scores[:-1], True)  # equal scores stay together
        return float(scores[last][np.argmax(f1[last])])

    def make_rows(self, min_score: float = -np.inf) -> dict[str, dict]:
        """Return the table of matching.Score for detections of min_score or more."""
        total = Score()
        for truth, boxes, scores in self.frames:
            total.update(boxes[scores >= min_score], truth)
        return total.make_rows()

    def compute_f1_interval(self, min_score: float, count: int, follow: bool = False) -> list[float] | None:
        """Return the interval [low, high] of F1 in percent for detections of min_score or more.

        It comes from `count` draws of group_frames(names, follow), see intervals.py.
        """
        found = [boxes[scores >= min_score] for _, boxes, scores in self.frames]
        counts = np.array(
            [
                [len(match_centres(boxes, truth)[0]), len(boxes), len(truth)]
                for boxes, (truth, _, _) in zip(found, self.frames)
            ]
        ).reshape(-1, 3)

        def f1(frames: np.ndarray) -> float:
            hits, boxes, true = counts[frames].sum(axis=0)
            return 200 * hits / (boxes + true)

        return compute_interval(f1, group_frames(self.names, follow), count)

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
