"""Steps of the tracker for one frame: predict, match, update, start and prune tracks.

Tracks and detections are in the same fixed frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from lidar_perception.detectors.nms import rotated_nms
from lidar_perception.tracking import existence, motion
from lidar_perception.tracking.association import assign, find_pairs
from lidar_perception.tracking.params import MODEL_BY_CLASS_ID, TrackingParams
from lidar_perception.tracking.state import States
from lidar_perception.types import CLASSES, PEDESTRIAN

HEIGHT_NOISE = 0.2  # standard deviation of a measured z, m
HEIGHT_DRIFT = 0.3  # process noise density of an object's z, m/s^0.5
MAX_SIZE_WEIGHT = 20.0  # maximum weight of the mean size, a sum of scores
CLASS_LEAD = 0.5  # a track changes its class if the evidence for another class is higher by more than this
HIT_MEMORY = 20.0  # time constant with which hits and heading agreement fade, in frames
DECAY = 1.0 - 1.0 / HIT_MEMORY
MODEL_IDS = np.array(MODEL_BY_CLASS_ID)
MAX_REVERSE_SPEED = np.array([2.0, 0.3, 1.0])  # maximum speed in reverse of each motion model, m/s


def predict(states: States, seconds: float, params: TrackingParams) -> States:
    """Predict the tracks `seconds` ahead."""
    models = MODEL_IDS[states.class_ids]
    means, covariances = motion.predict(
        states.means,
        states.covariances,
        seconds,
        *(_collect_by_model(params, name)[models] for name in ("acceleration", "turning", "wandering")),
    )
    fade_factor = np.exp(-seconds / params.existence.memory)
    return replace(
        states,
        means=means,
        covariances=covariances,
        ages=states.ages + seconds,
        unseen_s=states.unseen_s + seconds,
        evidence=states.evidence * fade_factor,
        observations=states.observations * fade_factor,
        class_evidence=states.class_evidence * fade_factor,
        height_variances=states.height_variances + HEIGHT_DRIFT**2 * seconds,
    )


def match(
    states: States, boxes: np.ndarray, class_ids: np.ndarray, scores: np.ndarray, params: TrackingParams, seconds: float
) -> tuple[np.ndarray, np.ndarray]:
    """Match the tracks with the detections of a frame, `seconds` after the previous one.

    Strong detections are matched first, then weak ones with the remaining tracks (Zhang et al.,
    ByteTrack, ECCV 2022).

    Returns:
        The indices of the matched tracks (P,) and of their detections (P,).
    """
    models = MODEL_IDS[states.class_ids]
    noise = _collect_by_model(params, "position")[models]
    deviations = np.sqrt(np.maximum(states.covariances[:, 0, 0], states.covariances[:, 1, 1]) + noise * noise)
    pairs = find_pairs(
        states.to_boxes(),
        deviations,
        models,
        _collect_by_model(params, "reach")[models],
        boxes,
        MODEL_IDS[class_ids],
        params.association,
        seconds,
    )
    is_strong = (scores >= params.association.strong)[pairs.boxes]
    i, j = assign(pairs.select(is_strong))
    weak_tracks, weak_detections = assign(pairs.select(~is_strong & ~np.isin(pairs.tracks, i)))
    return np.concatenate([i, weak_tracks]), np.concatenate([j, weak_detections])


def update(
    states: States,
    i: np.ndarray,
    boxes: np.ndarray,
    class_ids: np.ndarray,
    scores: np.ndarray,
    params: TrackingParams,
    is_fixed: bool,
    seconds: float,
) -> States:
    """Update the tracks with the detections of a frame.

    Args:
        states: States of N tracks, predicted to the time of this frame.
        i: (P,) indices of the tracks with a detection; a miss is counted for the others.
        boxes: (P, 7) detected boxes.
        class_ids: (P,) classes of the detections.
        scores: (P,) scores of the detections.
        is_fixed: True if the frame is fixed to the ground. Only then are objects assumed to move
            along their heading.
        seconds: Time since the previous frame.
    """
    new_states = states.copy()
    models = MODEL_IDS[states.class_ids[i]]
    noise = np.column_stack(
        [*[_collect_by_model(params, "position")[models]] * 2, _collect_by_model(params, "heading")[models]]
    )
    means, covariances = motion.update(states.means[i], states.covariances[i], boxes[:, [0, 1, 6]], noise)
    if is_fixed:
        means, covariances = motion.constrain_to_heading(means, covariances, _collect_by_model(params, "slip")[models])
    agreement = states.heading_agreement[i] * DECAY + scores * np.sign(np.cos(boxes[:, 6] - means[:, motion.HEADING]))
    new_states.means[i], new_states.heading_agreement[i] = motion.flip_reversed_headings(
        means, agreement, MAX_REVERSE_SPEED[models] if is_fixed else np.full(len(i), np.inf)
    )
    new_states.covariances[i] = covariances
    gain = states.height_variances[i] / (states.height_variances[i] + HEIGHT_NOISE**2)
    new_states.heights[i] += gain * (boxes[:, 2] - states.heights[i])
    new_states.height_variances[i] *= 1.0 - gain
    weights = scores / (states.size_weights[i] + scores)
    new_states.sizes[i] += weights[:, None] * (boxes[:, 3:6] - states.sizes[i])
    new_states.size_weights[i] = np.minimum(states.size_weights[i] + scores, MAX_SIZE_WEIGHT)
    new_states.moving[:] = compute_moving_probability(new_states.means, new_states.covariances, params.moving_speed)
    _add_evidence(new_states, i, class_ids, scores, params, seconds)
    return new_states


def _add_evidence(
    states: States, i: np.ndarray, class_ids: np.ndarray, scores: np.ndarray, params: TrackingParams, seconds: float
) -> None:
    """Add the evidence of one frame to the states, in place."""
    existence_params = params.existence
    is_missed = np.ones(len(states), bool)
    is_missed[i] = False
    states.evidence[is_missed] += existence_params.missed
    states.observations[:] += 1.0
    states.evidence[i] += existence.compute_evidence(scores, existence_params)
    states.class_evidence[i, class_ids] += scores
    best_classes = states.class_evidence.argmax(axis=1)
    rows = np.arange(len(states))
    is_better = states.class_evidence[rows, best_classes] > (states.class_evidence[rows, states.class_ids] + CLASS_LEAD)
    states.class_ids[is_better] = best_classes[is_better]
    penalty = existence.compute_miss_penalty(states.hits, states.tries, seconds, existence_params)
    states.presence[is_missed] -= penalty[is_missed]
    states.presence[i] = np.minimum(states.presence[i] + existence_params.seen, existence_params.max_present)
    states.hits[:] *= DECAY
    states.tries[:] *= DECAY
    states.hits[i] += 1.0
    states.tries[:] += 1.0
    states.unseen_s[i] = 0.0


def start_tracks(
    first_id: int, boxes: np.ndarray, class_ids: np.ndarray, scores: np.ndarray, params: TrackingParams
) -> States:
    """Start one track with zero velocity for each of K detections."""
    count, models = len(boxes), MODEL_IDS[class_ids]
    noise, heading, speed, turning = (
        _collect_by_model(params, name)[models] for name in ("position", "heading", "first_speed", "turning")
    )
    means = np.zeros((count, 6))
    means[:, motion.MEASURED_INDICES] = boxes[:, [0, 1, 6]]
    variances = np.column_stack([noise, noise, speed, speed, heading, np.where(turning > 0, 0.3, 0.0)]) ** 2
    covariances = np.einsum("ni,ij->nij", variances, np.eye(6))
    existence_params, zeros, ones = params.existence, np.zeros(count), np.ones(count)
    class_evidence = np.zeros((count, len(CLASSES)))
    class_evidence[np.arange(count), class_ids] = scores
    return States(
        first_id + np.arange(count),
        means,
        covariances,
        boxes[:, 2].copy(),
        np.full(count, HEIGHT_NOISE**2),
        boxes[:, 3:6].copy(),
        scores.copy(),
        class_evidence,
        class_ids.astype(np.int32),
        existence.compute_evidence(scores, existence_params),
        ones,
        np.full(count, existence_params.seen / 2),
        ones.copy(),
        ones.copy(),
        compute_moving_probability(means, covariances, params.moving_speed),
        zeros.copy(),
        zeros.copy(),
        scores.copy(),
    )


def prune(states: States, params: TrackingParams, is_fixed: bool) -> States:
    """Remove tracks that are probably gone, and all but the most probable of overlapping tracks."""
    states = states.take(np.flatnonzero(existence.to_probability(states.presence) >= params.existence.end))
    probabilities = compute_probabilities(states, params, is_fixed)
    kept_indices = rotated_nms(states.to_boxes(), probabilities, states.class_ids, params.overlap, across_classes=True)
    return states.take(np.sort(kept_indices[: params.max_tracks]))


def compute_probabilities(states: States, params: TrackingParams, is_fixed: bool) -> np.ndarray:
    """Compute the probability (N,) that each track is real, of its class, and present.

    Motion is evidence for an object only if the frame is fixed to the ground (`is_fixed`).
    """
    existence_params, no_motion = params.existence, np.zeros(len(states))
    validity = existence.compute_validity(
        states.evidence, states.observations, states.moving if is_fixed else no_motion, existence_params
    )
    if is_fixed:
        fast_probability = compute_moving_probability(states.means, states.covariances, existence_params.walking)
        fast_probability *= find_pedestrians(states)
        validity -= existence_params.faster * np.maximum(2.0 * fast_probability - 1.0, 0.0)
    return existence.to_probability(validity) * existence.to_probability(states.presence)


def find_pedestrians(states: States) -> np.ndarray:
    """Return a mask (N,) of the tracks with the motion model of pedestrians."""
    return MODEL_IDS[states.class_ids] == MODEL_BY_CLASS_ID[PEDESTRIAN]


def compute_moving_probability(means: np.ndarray, covariances: np.ndarray, speed: float) -> np.ndarray:
    """Compute the probability (N,) that each object moves faster than `speed`, in m/s."""
    vx, vy = means[:, motion.VX], means[:, motion.VY]
    speeds = np.hypot(vx, vy)
    ux, uy = (np.divide(v, speeds, out=np.full_like(v, np.sqrt(0.5)), where=speeds > 1e-6) for v in (vx, vy))
    variance = ux * ux * covariances[:, 2, 2] + 2 * ux * uy * covariances[:, 2, 3] + uy * uy * covariances[:, 3, 3]
    return ndtr((speeds - speed) / np.sqrt(np.maximum(variance, 1e-12)))


def _collect_by_model(params: TrackingParams, name: str) -> np.ndarray:
    """Return one motion parameter of each motion model, in the order of MOTION_MODELS."""
    return np.array([getattr(motion_params, name) for motion_params in params.list_motion_params()])
