"""AB3DMOT's sAMOTA, AMOTA and AMOTP (Weng et al., IROS 2020): CLEAR MOT in 3D, averaged over recall.

The counts follow the paper's own script for KITTI with 3D IoU: each of 40 thresholds selects the
tracks with at least this mean score. Unlike CLEAR MOT, the script counts matches of ignored labels
as true positives, counts an id switch only between consecutive frames, and does not prefer the
match of the previous frame.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from lidar_perception.scoring.tracking.pairs import Pairs

MIN_OVERLAP = 0.25  # minimum IoU of a match
STEPS = 40  # number of recalls 1/40, 2/40, ..., 1
FORBIDDEN_COST = 1e6  # cost of a pair below MIN_OVERLAP


@dataclass(frozen=True)
class RecallPoint:
    """Counts for tracks with a mean score of at least `threshold`.

    tp includes matches of ignored labels. objects and fn exclude ignored labels. overlap is the sum of
    the IoU of all matches.
    """

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
        """MOTA, at most 1; -inf without objects."""
        return 1 - (self.fn + self.fp + self.switches) / self.objects if self.objects else -np.inf

    @property
    def smota(self) -> float:
        """MOTA divided by the best possible value at this recall, clipped to 0..1."""
        if not self.objects:
            return 0.0
        errors = self.fn + self.fp + self.switches - (1 - self.recall) * self.objects
        return min(1.0, max(0.0, 1 - errors / (self.recall * self.objects)))


def score_over_recall(sequences: list[list[Pairs]]) -> dict[str, float | None]:
    """Compute sAMOTA, AMOTA, AMOTP, best_MOTA, and best_score (the threshold of best_MOTA).

    If no track matches, the scores are 0 and best_score is None.

    Args:
        sequences: Frames of each sequence in order, as returned by make_pairs.
    """
    means = [_average_scores(frames) for frames in sequences]
    has_matched = [[np.zeros(len(f.track_ids), bool) for f in frames] for frames in sequences]
    hits: list[float] = []
    all_tracks = _count_at_threshold(sequences, means, has_matched, -np.inf, 1.0, hits)
    points = [
        _count_at_threshold(sequences, means, has_matched, threshold, recall, [])
        for threshold, recall in _choose_thresholds(np.array(hits), all_tracks.tp + all_tracks.fn)
    ]
    best = max(points, key=lambda p: p.mota, default=None)
    if best is None or best.mota <= 0:
        best = None
    return {
        "sAMOTA": sum(p.smota for p in points) / STEPS,
        "AMOTA": sum(p.mota for p in points if p.objects) / STEPS,
        "AMOTP": sum(p.overlap / max(p.tp, 1) for p in points) / STEPS,
        "best_MOTA": best.mota if best else 0.0,
        "best_score": best.threshold if best else None,
    }


def _average_scores(frames: list[Pairs]) -> dict[int, float]:
    scores: dict[int, list[float]] = {}
    for f in frames:
        for i, score in zip(f.track_ids.tolist(), f.scores.tolist()):
            scores.setdefault(i, []).append(score)
    return {i: sum(values) / len(values) for i, values in scores.items()}


def _choose_thresholds(scores: np.ndarray, objects: int) -> list[tuple[float, float]]:
    """Return the score thresholds with the recall nearest to 1/40, 2/40, .., as (score, recall)."""
    sorted_scores, thresholds, target_recall = np.sort(scores)[::-1], [], 0.0
    for i, score in enumerate(sorted_scores.tolist()):
        recall = (i + 1) / objects
        next_recall = (i + 2) / objects if i + 1 < len(sorted_scores) else recall
        if next_recall - target_recall < target_recall - recall and i + 1 < len(sorted_scores):
            continue
        thresholds.append((score, target_recall))
        target_recall += 1 / STEPS
    return thresholds[1:]


def _count_at_threshold(
    sequences: list[list[Pairs]],
    means: list[dict[int, float]],
    has_matched: list[list[np.ndarray]],
    threshold: float,
    recall: float,
    hits: list[float],
) -> RecallPoint:
    """Count matches, misses, false positives and id switches at one score threshold.

    Appends the score of each match to `hits`. Updates `has_matched` in place: a track that has matched
    once is never excused again, as in the paper's script.
    """
    tp = fn = fp = switches = objects = 0
    overlap = 0.0
    for frames, score, sequence_has_matched in zip(sequences, means, has_matched):
        histories: dict[int, list[tuple[int, bool]]] = {}
        for f, track_has_matched in zip(frames, sequence_has_matched):
            mean_scores = np.array([score[i] for i in f.track_ids.tolist()])
            track_indices = np.flatnonzero(mean_scores >= threshold) if len(mean_scores) else np.zeros(0, int)
            rows, columns = _match(f.overlap[:, track_indices])
            columns = track_indices[columns]
            track_has_matched[columns] = True
            hits += mean_scores[columns].tolist()
            is_excused = f.is_excused[track_indices] & ~track_has_matched[track_indices]
            ignored_hits = int(f.is_ignored[rows].sum())
            label_count = int((~f.is_ignored).sum())
            objects += label_count
            tp += len(rows)
            fn += label_count - (len(rows) - ignored_hits)
            fp += len(track_indices) - len(rows) - int(is_excused.sum())
            overlap += float(f.overlap[rows, columns].sum())
            ids = np.full(len(f.true_ids), -1, np.int64)
            ids[rows] = f.track_ids[columns]
            for true_id, track, is_ignored in zip(f.true_ids.tolist(), ids.tolist(), f.is_ignored):
                histories.setdefault(true_id, []).append((track, bool(is_ignored)))
        switches += sum(map(_count_switches, histories.values()))
    return RecallPoint(threshold, recall, tp, fn, fp, switches, objects, overlap)


def _match(overlap: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cost = np.where(overlap >= MIN_OVERLAP, 1.0 - overlap, FORBIDDEN_COST)
    rows, columns = linear_sum_assignment(cost)
    is_allowed = cost[rows, columns] < FORBIDDEN_COST
    return rows[is_allowed], columns[is_allowed]


def _count_switches(history: list[tuple[int, bool]]) -> int:
    """Count the id switches of one labelled object.

    Args:
        history: Track id (-1 for none) and ignored flag, for each frame of the object.
    """
    count, last_track = 0, history[0][0]
    if all(is_ignored for _, is_ignored in history):
        return 0
    for (previous_track, _), (track, is_ignored) in itertools.pairwise(history):
        if is_ignored:
            last_track = -1
            continue
        count += last_track != track and last_track != -1 and track != -1 and previous_track != -1
        last_track = track if track != -1 else last_track
    return count
