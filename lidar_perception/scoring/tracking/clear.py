"""CLEAR MOT (Bernardin and Stiefelhagen, 2008) as counted by TrackEval."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from lidar_perception.scoring.tracking.pairs import EPS, MIN_SIMILARITY, Pairs, find_best_pairs

CONTINUATION_GAIN = 1000.0  # bonus for pairs of the previous frame, larger than any similarity


@dataclass(frozen=True)
class ClearCounts:
    """Counts of one or more sequences.

    Attributes:
        tp, fn, fp: boxes.
        switches: labels matched to another id than the last time.
        fragments: labels matched again after a gap.
        mostly_tracked, partly_tracked, mostly_lost: labelled tracks matched in more than 80 %, in
            20 % or more, in less than 20 % of their frames.
        located: sum of similarities.
    """

    tp: int = 0
    fn: int = 0
    fp: int = 0
    switches: int = 0
    fragments: int = 0
    mostly_tracked: int = 0
    partly_tracked: int = 0
    mostly_lost: int = 0
    located: float = 0.0

    def __add__(self, other: ClearCounts) -> ClearCounts:
        return ClearCounts(*(a + b for a, b in zip(astuple(self), astuple(other))))

    def compute_scores(self) -> dict[str, float]:
        """Return MOTA (at most 1, may be negative), MOTP, recall and precision; 0 without cases."""
        objects = max(1, self.tp + self.fn)
        return {
            "MOTA": (self.tp - self.fp - self.switches) / objects,
            "MOTP": self.located / max(1, self.tp),
            "recall": self.tp / objects,
            "precision": self.tp / max(1, self.tp + self.fp),
        }


def count_clear(frames: list[Pairs], alike: float = MIN_SIMILARITY) -> ClearCounts:
    """Count one sequence; its frames in order, as returned by drop_ignored.

    Boxes of a similarity of at least `alike` can match. A pair of the previous frame is kept if
    possible.
    """
    true_ids = np.unique(np.concatenate([np.zeros(0, np.int64), *(f.true_ids for f in frames)]))
    last, before = (np.full(len(true_ids), -1, np.int64) for _ in range(2))
    seen, found, runs = (np.zeros(len(true_ids), int) for _ in range(3))
    tp = fp = switches = 0
    located = 0.0
    for f in frames:
        i = np.searchsorted(true_ids, f.true_ids)
        seen[i] += 1
        fp += len(f.track_ids)
        if len(i) == 0 or len(f.track_ids) == 0:
            continue  # earlier matches can continue after such a frame, as in TrackEval
        gain = CONTINUATION_GAIN * (f.track_ids == before[i][:, None]) + f.similarity
        rows, columns = find_best_pairs(np.where(f.similarity < alike - EPS, 0.0, gain))
        who, ids = i[rows], f.track_ids[columns]
        switches += int(((last[who] >= 0) & (last[who] != ids)).sum())
        runs[who] += before[who] < 0
        last[who] = ids
        before[:] = -1
        before[who] = ids
        found[who] += 1
        tp += len(who)
        fp -= len(who)
        located += float(f.similarity[rows, columns].sum())
    share = found / np.maximum(seen, 1)
    most, some = int((share > 0.8).sum()), int((share >= 0.2).sum())
    return ClearCounts(
        tp,
        int(seen.sum()) - tp,
        fp,
        switches,
        int(np.maximum(runs - 1, 0).sum()),
        most,
        some - most,
        len(true_ids) - some,
        located,
    )
