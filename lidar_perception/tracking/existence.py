"""Probabilities that a track is a real object of its class, and that it is still present.

Both are computed as sums of evidence in log odds. Observations of one object are correlated: a post
that looks like a person does so in every frame. Therefore n observations count as
n / (1 + (n - 1) correlation) independent ones, the design effect of cluster sampling (Kish, Survey
Sampling, 1965). The presence is computed from hits and misses, given the track's hit rate so far.
"""

from __future__ import annotations

import numpy as np

from lidar_perception.tracking.params import NOMINAL_PERIOD_S, ExistenceParams

MIN_PROBABILITY = 0.01  # scores are clipped to MIN_PROBABILITY .. 1 - MIN_PROBABILITY
PRIOR_HITS, PRIOR_TRIES = 1.0, 2.0  # hits and frames added to those of a track to estimate its hit rate
MAX_HIT_RATE = 0.95


def to_log_odds(probability: np.ndarray | float) -> np.ndarray:
    """Convert probabilities, clipped to MIN_PROBABILITY .. 1 - MIN_PROBABILITY, to log odds."""
    p = np.clip(probability, MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
    return np.log(p / (1.0 - p))


def to_probability(log_odds: np.ndarray) -> np.ndarray:
    """Convert log odds to probabilities, without the clipping of to_log_odds."""
    return 1.0 / (1.0 + np.exp(-np.clip(log_odds, -50.0, 50.0)))


def compute_evidence(scores: np.ndarray, params: ExistenceParams) -> np.ndarray:
    """Compute the evidence (N,) from scores (N,); positive values are evidence for an object."""
    return params.gain * (to_log_odds(scores) - to_log_odds(params.neutral))


def discount_observations(count: np.ndarray, correlation: float) -> np.ndarray:
    """Return the number (N,) of independent observations equivalent to `count` (N,) correlated ones."""
    return count / (1.0 + np.maximum(count - 1.0, 0.0) * correlation)


def compute_validity(
    evidence: np.ndarray, count: np.ndarray, moving: np.ndarray, params: ExistenceParams
) -> np.ndarray:
    """Compute the log odds (N,) that tracks are real objects of their class.

    Args:
        evidence: (N,) sum of the evidence.
        count: (N,) number of observations.
        moving: (N,) probability of motion; values above 0.5 are evidence for an object.
    """
    mean_evidence = evidence / np.maximum(count, 1e-9)
    return (
        params.prior
        + mean_evidence * discount_observations(count, params.correlation)
        + params.moves * np.maximum(2.0 * moving - 1.0, 0.0)
    )


def compute_miss_penalty(hits: np.ndarray, tries: np.ndarray, seconds: float, params: ExistenceParams) -> np.ndarray:
    """Compute how much a miss lowers the log odds (N,) of presence.

    The penalty rises with the hit rate of a track up to params.max_absence per NOMINAL_PERIOD_S.
    The limit is per time, not per frame, because misses are correlated: the duration of an
    occlusion does not depend on the frame rate.

    Args:
        hits: (N,) number of hits.
        tries: (N,) number of frames.
        seconds: Time since the previous frame.
    """
    rate = np.minimum((hits + PRIOR_HITS) / (tries + PRIOR_TRIES), MAX_HIT_RATE)
    return np.minimum(-np.log(1.0 - rate), params.max_absence * (seconds / NOMINAL_PERIOD_S))
