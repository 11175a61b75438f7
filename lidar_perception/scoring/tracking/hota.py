"""HOTA (Luiten et al., IJCV 2021), the balance of detection and association of tracks.

Counts are added over sequences; scores are computed from the sums.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from lidar_perception.scoring.tracking.pairs import EPS, Pairs, find_best_pairs

ALPHAS = np.arange(0.05, 0.99, 0.05)  # 19 similarity thresholds


def _zeros() -> np.ndarray:
    return np.zeros(len(ALPHAS))


@dataclass(frozen=True)
class HotaCounts:
    """Counts at each of ALPHAS, (19,) float64.

    Attributes:
        tp, fn, fp: counts of boxes.
        associated: sum over true positives of the share of frames in which their tracks match.
        located: sum over true positives of their similarity.
    """

    tp: np.ndarray = field(default_factory=_zeros)
    fn: np.ndarray = field(default_factory=_zeros)
    fp: np.ndarray = field(default_factory=_zeros)
    associated: np.ndarray = field(default_factory=_zeros)
    located: np.ndarray = field(default_factory=_zeros)

    def __add__(self, other: HotaCounts) -> HotaCounts:
        return HotaCounts(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))

    def compute_scores(self) -> dict[str, float]:
        """Return HOTA, DetA, AssA, DetRe, DetPr and LocA, 0..1, averaged over ALPHAS.

        They are 0 without cases.
        """
        det_a = self.tp / np.maximum(1.0, self.tp + self.fn + self.fp)
        ass_a = self.associated / np.maximum(1.0, self.tp)
        curves = {
            "HOTA": np.sqrt(det_a * ass_a),
            "DetA": det_a,
            "AssA": ass_a,
            "DetRe": self.tp / np.maximum(1.0, self.tp + self.fn),
            "DetPr": self.tp / np.maximum(1.0, self.tp + self.fp),
            "LocA": np.maximum(1e-10, self.located) / np.maximum(1e-10, self.tp),
        }
        return {name: float(curve.mean()) for name, curve in curves.items()}


def count_hota(frames: list[Pairs]) -> HotaCounts:
    """Count one sequence; its frames in order, as returned by drop_ignored."""
    true_ids = np.unique(np.concatenate([np.zeros(0, np.int64), *(f.true_ids for f in frames)]))
    track_ids = np.unique(np.concatenate([np.zeros(0, np.int64), *(f.track_ids for f in frames)]))
    indices = [(np.searchsorted(true_ids, f.true_ids), np.searchsorted(track_ids, f.track_ids)) for f in frames]
    together = np.zeros((len(true_ids), len(track_ids)))  # summed weight of each pair
    true_count, track_count = np.zeros((len(true_ids), 1)), np.zeros((1, len(track_ids)))
    for f, (i, j) in zip(frames, indices):
        s = f.similarity
        either = s.sum(axis=0) + s.sum(axis=1)[:, None] - s
        together[np.ix_(i, j)] += np.divide(s, either, out=np.zeros_like(s), where=either > EPS)
        true_count[i] += 1
        track_count[0, j] += 1
    alignment = together / np.maximum(true_count + track_count - together, EPS)
    matches = np.zeros((len(ALPHAS), len(true_ids), len(track_ids)))
    located = _zeros()
    for f, (i, j) in zip(frames, indices):
        # pairs of similarity 0 can be assigned too; they are below every alpha
        rows, columns = find_best_pairs(alignment[np.ix_(i, j)] * f.similarity)
        alike = f.similarity[rows, columns]
        is_match = alike >= ALPHAS[:, None] - EPS
        matches[:, i[rows], j[columns]] += is_match
        located += (is_match * alike).sum(axis=1)
    tp = matches.sum(axis=(1, 2))
    either = np.maximum(1.0, true_count + track_count - matches)
    return HotaCounts(
        tp, true_count.sum() - tp, track_count.sum() - tp, (matches * matches / either).sum(axis=(1, 2)), located
    )
