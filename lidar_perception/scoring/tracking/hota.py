"""HOTA (Luiten et al., IJCV 2021), a tracking score that balances detection and association.

Counts are summed over sequences; scores are computed from the sums.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from lidar_perception.scoring.tracking.pairs import EPS, Pairs, find_best_pairs

ALPHAS = np.arange(0.05, 0.99, 0.05)  # 19 similarity thresholds


def _make_zeros() -> np.ndarray:
    return np.zeros(len(ALPHAS))


@dataclass(frozen=True)
class HotaCounts:
    """Counts at each similarity threshold of ALPHAS, (19,) float64.

    Attributes:
        tp: True positives.
        fn: Misses.
        fp: False positives.
        association: Sum of the association accuracies of the true positives.
        similarity: Sum of the similarities of the true positives.
    """

    tp: np.ndarray = field(default_factory=_make_zeros)
    fn: np.ndarray = field(default_factory=_make_zeros)
    fp: np.ndarray = field(default_factory=_make_zeros)
    association: np.ndarray = field(default_factory=_make_zeros)
    similarity: np.ndarray = field(default_factory=_make_zeros)

    def __add__(self, other: HotaCounts) -> HotaCounts:
        return HotaCounts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def compute_scores(self) -> dict[str, float]:
        """Return HOTA, DetA, AssA, DetRe, DetPr and LocA, 0..1, averaged over ALPHAS.

        A ratio with denominator 0 is 0.
        """
        det_a = self.tp / np.maximum(1.0, self.tp + self.fn + self.fp)
        ass_a = self.association / np.maximum(1.0, self.tp)
        curves = {
            "HOTA": np.sqrt(det_a * ass_a),
            "DetA": det_a,
            "AssA": ass_a,
            "DetRe": self.tp / np.maximum(1.0, self.tp + self.fn),
            "DetPr": self.tp / np.maximum(1.0, self.tp + self.fp),
            "LocA": np.maximum(1e-10, self.similarity) / np.maximum(1e-10, self.tp),
        }
        return {name: float(curve.mean()) for name, curve in curves.items()}


def count_hota(frames: list[Pairs]) -> HotaCounts:
    """Count one sequence.

    Args:
        frames: Frames of the sequence in order, as returned by drop_ignored.
    """
    true_ids = np.unique(np.concatenate([np.zeros(0, np.int64), *(f.true_ids for f in frames)]))
    track_ids = np.unique(np.concatenate([np.zeros(0, np.int64), *(f.track_ids for f in frames)]))
    indices = [(np.searchsorted(true_ids, f.true_ids), np.searchsorted(track_ids, f.track_ids)) for f in frames]
    shared_frames = np.zeros(
        (len(true_ids), len(track_ids))
    )  # number of common frames of each pair, weighted by similarity
    true_frames, track_frames = np.zeros((len(true_ids), 1)), np.zeros((1, len(track_ids)))
    for f, (i, j) in zip(frames, indices):
        similarity = f.similarity
        union = similarity.sum(axis=0) + similarity.sum(axis=1)[:, None] - similarity
        shared_frames[np.ix_(i, j)] += np.divide(similarity, union, out=np.zeros_like(similarity), where=union > EPS)
        true_frames[i] += 1
        track_frames[0, j] += 1
    alignment = shared_frames / np.maximum(true_frames + track_frames - shared_frames, EPS)
    matches = np.zeros((len(ALPHAS), len(true_ids), len(track_ids)))
    similarity_sum = _make_zeros()
    for f, (i, j) in zip(frames, indices):
        # Pairs of similarity 0 may be assigned too. They are below every alpha.
        rows, columns = find_best_pairs(alignment[np.ix_(i, j)] * f.similarity)
        similarities = f.similarity[rows, columns]
        is_match = similarities >= ALPHAS[:, None] - EPS
        matches[:, i[rows], j[columns]] += is_match
        similarity_sum += (is_match * similarities).sum(axis=1)
    tp = matches.sum(axis=(1, 2))
    union = np.maximum(1.0, true_frames + track_frames - matches)
    return HotaCounts(
        tp,
        true_frames.sum() - tp,
        track_frames.sum() - tp,
        (matches * matches / union).sum(axis=(1, 2)),
        similarity_sum,
    )
