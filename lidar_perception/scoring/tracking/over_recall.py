"""AB3DMOT's sAMOTA, AMOTA and AMOTP (Weng et al., IROS 2020): CLEAR MOT in space, averaged over
recall, by the counting of its own script (KITTI's, with 3D IoU).

Tracks count by the mean of their scores; from the best down, 40 thresholds take them in. Beside
CLEAR MOT the script counts hits on labels that need not be found as true positives, an id switch
only between neighbouring frames, and does not prefer the pair of the frame before.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from lidar_perception.scoring.tracking.pairs import Pairs

MIN_OVERLAP = 0.25  # of boxes that can match
STEPS = 40      # recall 1/40, 2/40, .. 1
FORBIDDEN = 1e6  # cost of a pair that overlaps too little


@dataclass(frozen=True)
class RecallPoint:
    """Counts with the tracks whose mean score is threshold or more. tp with, objects and fn without
    the labels that need not be found; overlap: the sum over tp."""

    threshold: float
    recall: float
    tp: int
    fn: int
    fp: int
    switches: int
    objects: int
    overlap: float

    @property
    def mota(self) -> float:
        """1 and less; -inf without objects."""
        return 1 - (self.fn + self.fp + self.switches) / self.objects if self.objects else -np.inf

    @property
    def smota(self) -> float:
        """0..1: MOTA with 1 for all that can be had at this recall."""
        if not self.objects:
            return 0.0
        wrong = self.fn + self.fp + self.switches - (1 - self.recall) * self.objects
        return min(1.0, max(0.0, 1 - wrong / (self.recall * self.objects)))


def score_over_recall(sequences: list[list[Pairs]]) -> dict[str, float | None]:
    """sAMOTA, AMOTA, AMOTP, and best_MOTA with its threshold best_score, of sequences of frames in
    order (as pairs_of gives them); 0 without a track that matches, best_score then None."""
    means = [_average_scores(frames) for frames in sequences]
    matched = [[np.zeros(len(f.track_ids), bool) for f in frames] for frames in sequences]
    hits: list[float] = []
    first = _count_at_threshold(sequences, means, matched, -np.inf, 1.0, hits)
    points = [_count_at_threshold(sequences, means, matched, threshold, recall, [])
              for threshold, recall in _choose_thresholds(np.array(hits), first.tp + first.fn)]
    best = max(points, key=lambda p: p.mota, default=None)
    if best is None or best.mota <= 0:
        best = None
    return {"sAMOTA": sum(p.smota for p in points) / STEPS,
            "AMOTA": sum(p.mota for p in points if p.objects) / STEPS,
            "AMOTP": sum(p.overlap / max(p.tp, 1) for p in points) / STEPS,
            "best_MOTA": best.mota if best else 0.0, "best_score": best.threshold if best else None}


def _average_scores(frames: list[Pairs]) -> dict[int, float]:
    scores: dict[int, list[float]] = {}
    for f in frames:
        for i, score in zip(f.track_ids.tolist(), f.scores.tolist()):
            scores.setdefault(i, []).append(score)
    return {i: sum(values) / len(values) for i, values in scores.items()}


def _choose_thresholds(scores: np.ndarray, objects: int) -> list[tuple[float, float]]:
    """Score and recall: of the scores of all hits those nearest to recall 1/40, 2/40, .."""
    ordered, chosen, wanted = np.sort(scores)[::-1], [], 0.0
    for i, score in enumerate(ordered.tolist()):
        recall = (i + 1) / objects
        following = (i + 2) / objects if i + 1 < len(ordered) else recall
        if following - wanted < wanted - recall and i + 1 < len(ordered):
            continue
        chosen.append((score, wanted))
        wanted += 1 / STEPS
    return chosen[1:]


def _count_at_threshold(sequences: list[list[Pairs]], means: list[dict[int, float]],
                        matched: list[list[np.ndarray]], threshold: float, recall: float,
                        hits: list[float]) -> RecallPoint:
    """One pass. hits gets the score of every hit; matched is kept up: a track that once matched is
    never excused again, as in the script."""
    tp = fn = fp = switches = objects = 0
    overlap = 0.0
    for frames, score, was in zip(sequences, means, matched):
        stories: dict[int, list[tuple[int, bool]]] = {}
        for f, matched_once in zip(frames, was):
            average = np.array([score[i] for i in f.track_ids.tolist()])
            kept = np.flatnonzero(average >= threshold) if len(average) else np.zeros(0, int)
            rows, columns = _match(f.overlap[:, kept])
            columns = kept[columns]
            matched_once[columns] = True
            hits += average[columns].tolist()
            excused = f.excused[kept] & ~matched_once[kept]
            ignored_hits = int(f.ignored[rows].sum())
            need = int((~f.ignored).sum())
            objects += need
            tp += len(rows)
            fn += need - (len(rows) - ignored_hits)
            fp += len(kept) - len(rows) - int(excused.sum())
            overlap += float(f.overlap[rows, columns].sum())
            ids = np.full(len(f.true_ids), -1, np.int64)
            ids[rows] = f.track_ids[columns]
            for true_id, track, ignored in zip(f.true_ids.tolist(), ids.tolist(), f.ignored):
                stories.setdefault(true_id, []).append((track, bool(ignored)))
        switches += sum(map(_count_switches, stories.values()))
    return RecallPoint(threshold, recall, tp, fn, fp, switches, objects, overlap)


def _match(overlap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cost = np.where(overlap >= MIN_OVERLAP, 1.0 - overlap, FORBIDDEN)
    rows, columns = linear_sum_assignment(cost)
    good = cost[rows, columns] < FORBIDDEN
    return rows[good], columns[good]


def _count_switches(story: list[tuple[int, bool]]) -> int:
    """Of one label: in each of its frames the track it was found by, or -1, and whether it was
    one that need not be found."""
    count, last = 0, story[0][0]
    if all(ignored for _, ignored in story):
        return 0
    for (before, _), (track, ignored) in itertools.pairwise(story):
        if ignored:
            last = -1
            continue
        count += last != track and last != -1 and track != -1 and before != -1
        last = track if track != -1 else last
    return count
