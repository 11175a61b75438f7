"""CLEAR MOT (Bernardin and Stiefelhagen, 2008) as counted by TrackEval."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from lidar_perception.scoring.tracking.pairs import EPS, MIN_SIMILARITY, Pairs, find_best_pairs

CONTINUATION_GAIN = 1000.0  # gain of pairs that matched in the previous frame, above any similarity


@dataclass(frozen=True)
class ClearCounts:
    """Counts of one or more sequences.

    Attributes:
        tp: Boxes that match a label.
        fn: Labels without a match.
        fp: Boxes without a match.
        switches: Matches with another track id than in the last match of the labelled track.
        fragments: Gaps in the matches of labelled tracks.
        mostly_tracked: Labelled tracks that match in more than 80 % of their frames.
        partly_tracked: Labelled tracks that match in 20 % to 80 % of their frames.
        mostly_lost: Labelled tracks that match in less than 20 % of their frames.
        similarity: Sum of the similarities of all matches.
    """

    tp: int = 0
    fn: int = 0
    fp: int = 0
    switches: int = 0
    fragments: int = 0
    mostly_tracked: int = 0
    partly_tracked: int = 0
    mostly_lost: int = 0
    similarity: float = 0.0

    def __add__(self, other: ClearCounts) -> ClearCounts:
        return ClearCounts(*(a + b for a, b in zip(astuple(self), astuple(other))))

    def compute_scores(self) -> dict[str, float]:
        """Return MOTA (at most 1, can be negative), MOTP, recall and precision.

        A ratio with denominator 0 is 0.
        """
        objects = max(1, self.tp + self.fn)
        return {
            "MOTA": (self.tp - self.fp - self.switches) / objects,
            "MOTP": self.similarity / max(1, self.tp),
            "recall": self.tp / objects,
            "precision": self.tp / max(1, self.tp + self.fp),
        }


def count_clear(frames: list[Pairs]) -> ClearCounts:
    """Count the matches and errors of one sequence.

    A label keeps its track of the previous frame if possible.

    Args:
        frames: Frames of the sequence in order, as returned by drop_ignored.
    """
    true_ids = np.unique(np.concatenate([np.zeros(0, np.int64), *(f.true_ids for f in frames)]))
    last_track, previous_track = (np.full(len(true_ids), -1, np.int64) for _ in range(2))
    frame_counts, match_counts, run_counts = (np.zeros(len(true_ids), int) for _ in range(3))
    tp = fp = switches = 0
    similarity = 0.0
    for f in frames:
        i = np.searchsorted(true_ids, f.true_ids)
        frame_counts[i] += 1
        fp += len(f.track_ids)
        if len(i) == 0 or len(f.track_ids) == 0:
            continue  # previous_track is kept over such a frame, as in TrackEval
        gain = CONTINUATION_GAIN * (f.track_ids == previous_track[i][:, None]) + f.similarity
        rows, columns = find_best_pairs(np.where(f.similarity < MIN_SIMILARITY - EPS, 0.0, gain))
        matched_tracks, ids = i[rows], f.track_ids[columns]
        switches += int(((last_track[matched_tracks] >= 0) & (last_track[matched_tracks] != ids)).sum())
        run_counts[matched_tracks] += previous_track[matched_tracks] < 0
        last_track[matched_tracks] = ids
        previous_track[:] = -1
        previous_track[matched_tracks] = ids
        match_counts[matched_tracks] += 1
        tp += len(matched_tracks)
        fp -= len(matched_tracks)
        similarity += float(f.similarity[rows, columns].sum())
    matched_fraction = match_counts / np.maximum(frame_counts, 1)
    mostly_tracked, at_least_partly = int((matched_fraction > 0.8).sum()), int((matched_fraction >= 0.2).sum())
    return ClearCounts(
        tp,
        int(frame_counts.sum()) - tp,
        fp,
        switches,
        int(np.maximum(run_counts - 1, 0).sum()),
        mostly_tracked,
        at_least_partly - mostly_tracked,
        len(true_ids) - at_least_partly,
        similarity,
    )
