"""Is a track what it claims to be, and is it still there? Evidence in log odds.

Two questions, two sums. A post that looks like a person does so in every frame, and from every
side: looks at one object are correlated, so n of them count as n / (1 + (n - 1) correlation) (the
design effect of cluster sampling; Kish, Survey Sampling, 1965). Whether the object is still there
follows from hits and misses, with the probability of a hit as its own track shows it.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.tracking.params import FRAME, ExistenceParams

CLIP = 0.01          # scores beyond 0.01 .. 0.99 say no more than those
HITS, TRIES = 1.0, 2.0  # before a track has any
SURE = 0.95          # no object is hit more surely


def log_odds(probability: np.ndarray | float) -> np.ndarray:
    """Of probabilities between CLIP and 1 - CLIP; others are as these."""
    p = np.clip(probability, CLIP, 1.0 - CLIP)
    return np.log(p / (1.0 - p))


def probability(odds: np.ndarray) -> np.ndarray:
    """0..1, the inverse of log_odds without its limits."""
    return 1.0 / (1.0 + np.exp(-np.clip(odds, -50.0, 50.0)))


def evidence(scores: np.ndarray, params: ExistenceParams) -> np.ndarray:
    """(N,) what detections with scores (N,) say for (or, below 0, against) an object."""
    return params.gain * (log_odds(scores) - log_odds(params.neutral))


def effective_looks(looks: np.ndarray, correlation: float) -> np.ndarray:
    """(N,) how many independent looks these are: looks (N,), 0 or more, that are correlated."""
    return looks / (1.0 + np.maximum(looks - 1.0, 0.0) * correlation)


def real(total: np.ndarray, looks: np.ndarray, moving: np.ndarray,
         params: ExistenceParams) -> np.ndarray:
    """(N,) log odds of being what is claimed: total (N,) evidence of looks (N,); moving (N,)
    probability of motion, which speaks for an object as far as it is above a half."""
    mean = total / np.maximum(looks, 1e-9)
    return (params.prior + mean * effective_looks(looks, params.correlation)
            + params.moves * np.maximum(2.0 * moving - 1.0, 0.0))


def absence(hits: np.ndarray, tries: np.ndarray, seconds: float,
            params: ExistenceParams) -> np.ndarray:
    """(N,) what a miss, so many seconds after the frame before, takes from the log odds of being
    there, of tracks with hits (N,) in tries (N,): much where hits are the rule, but not more than
    max_absence by time. Misses come together, as what hides an object does so for a while, however
    many frames it takes."""
    rate = np.minimum((hits + HITS) / (tries + TRIES), SURE)
    return np.minimum(-np.log(1.0 - rate), params.max_absence * (seconds / FRAME))
