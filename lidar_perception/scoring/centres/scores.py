"""Pedestrians by centre distance (paper A, Section 3.8), for detections with a score.

F1 needs a decision which detections to keep, and a detector gives many of low score. So F1 is
given for all of them, and for those above the score at which it is best. The second is what
another choice can reach at most on these frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from lidar_perception.scoring.centres.matching import Score, match_centres
from lidar_perception.scoring.intervals import compute_interval, group_frames


@dataclass
class CentreScores:
    """Frames with at least one true pedestrian: true boxes (M, 7), found boxes (K, 7) and their
    scores (K,) by falling score; and their names."""

    frames: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def update(self, truth: np.ndarray, boxes: np.ndarray, scores: np.ndarray,
               name: str = "") -> None:
        """One frame; left out, as in the paper, where truth is empty."""
        if len(truth):
            order = np.lexsort([*boxes.T, -scores])
            self.frames.append((truth, boxes[order], scores[order]))
            self.names.append(name)

    def best_score(self) -> float | None:
        """The score from which detections are kept for the greatest F1; the highest of several.
        None without detections."""
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
        last = np.append(scores[1:] < scores[:-1], True)  # equal scores are kept together
        return float(scores[last][np.argmax(f1[last])])

    def table(self, min_score: float = -np.inf) -> dict[str, dict]:
        """The table of matching.Score for detections that score min_score or more."""
        total = Score()
        for truth, boxes, scores in self.frames:
            total.update(boxes[scores >= min_score], truth)
        return total.table()

    def compute_f1_interval(self, min_score: float, count: int, follow: bool = False
                            ) -> list[float] | None:
        """[low, high] of F1 in percent for detections that score min_score or more, from `count`
        drawings of blocks(names, follow); see intervals.py."""
        found = [boxes[scores >= min_score] for _, boxes, scores in self.frames]
        counts = np.array([[len(match_centres(boxes, truth)[0]), len(boxes), len(truth)]
                           for boxes, (truth, _, _) in zip(found, self.frames)]).reshape(-1, 3)

        def f1(frames: np.ndarray) -> float:
            hits, boxes, true = counts[frames].sum(axis=0)
            return 200 * hits / (boxes + true)

        return compute_interval(f1, group_frames(self.names, follow), count)

    def compute(self) -> dict:
        """What the JSON file holds."""
        best = self.best_score()
        return {"frames": len(self.frames), "ground_truth": sum(len(t) for t, _, _ in self.frames),
                "of_all": self.table(), "best_score": best,
                "at_best_score": self.table() if best is None else self.table(best)}
