"""One frame further: tracks and detections in the same fixed frame in, tracks out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from lidar_perception.detectors.nms import rotated_nms
from lidar_perception.tracking import existence, motion
from lidar_perception.tracking.association import FORBIDDEN, assigned, costs
from lidar_perception.tracking.params import KIND_OF_CLASS, TrackingParams
from lidar_perception.tracking.state import States
from lidar_perception.types import CLASSES, PEDESTRIAN

HEIGHT_NOISE = 0.2      # m, standard deviation of a measured z
HEIGHT_DRIFT = 0.3      # m/s^0.5, of the z of an object
MAX_SIZE_WEIGHT = 20.0  # a size is the mean of so many sure looks at most
CLASS_LEAD = 0.5        # evidence by which another class must lead to be taken over
MEMORY_OF_HITS = 20.0   # frames, of headings too
KEEP = 1.0 - 1.0 / MEMORY_OF_HITS
BACKWARDS = 2.0         # m/s, by kind times speed of walking below
KINDS = np.array(KIND_OF_CLASS)
BACKWARDS_BY_KIND = np.array([BACKWARDS, 0.3, 1.0])


def predicted(states: States, seconds: float, params: TrackingParams) -> States:
    """The tracks so many seconds later."""
    kinds = KINDS[states.class_ids]
    means, covariances = motion.predict(states.means, states.covariances, seconds,
                                        *(_by_kind(params, name)[kinds] for name in
                                          ("acceleration", "turning", "wandering")))
    fade = np.exp(-seconds / params.existence.memory)
    return replace(
        states, means=means, covariances=covariances, ages=states.ages + seconds,
        unseen=states.unseen + seconds, total=states.total * fade, looks=states.looks * fade,
        class_evidence=states.class_evidence * fade,
        height_variances=states.height_variances + HEIGHT_DRIFT ** 2 * seconds)


def matched(states: States, boxes: np.ndarray, class_ids: np.ndarray, scores: np.ndarray,
            params: TrackingParams, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Tracks (P,) and detections (P,) that belong together, so long after the frame before. Strong
    detections choose first, weak ones among the tracks that are left (Zhang et al., ByteTrack,
    ECCV 2022)."""
    kinds = KINDS[states.class_ids]
    noise = _by_kind(params, "position")[kinds]
    spread = np.sqrt(np.maximum(states.covariances[:, 0, 0], states.covariances[:, 1, 1])
                     + noise * noise)
    cost = costs(states.boxes(), spread, kinds, _by_kind(params, "reach")[kinds], boxes,
                 KINDS[class_ids], params.association, seconds)
    strong = scores >= params.association.strong
    i, j = assigned(np.where(strong, cost, FORBIDDEN))
    cost[i] = FORBIDDEN
    again, weak = assigned(np.where(strong, FORBIDDEN, cost))
    return np.concatenate([i, again]), np.concatenate([j, weak])


def updated(states: States, i: np.ndarray, boxes: np.ndarray, class_ids: np.ndarray,
            scores: np.ndarray, params: TrackingParams, fixed: bool, seconds: float) -> States:
    """The tracks after a frame, so many seconds after the one before, in which those at i (P,) were
    hit by boxes (P, 7), and the others missed. fixed: whether the frame stands, so that wheels and
    feet go forward in it; seen from a car, those of parked cars do not."""
    new = states.copy()
    kinds = KINDS[states.class_ids[i]]
    noise = np.column_stack([*[_by_kind(params, "position")[kinds]] * 2,
                             _by_kind(params, "heading")[kinds]])
    means, covariances = motion.update(states.means[i], states.covariances[i],
                                       boxes[:, [0, 1, 6]], noise)
    if fixed:
        means, covariances = motion.keep_to_heading(means, covariances,
                                                    _by_kind(params, "slip")[kinds])
    said = states.facing[i] * KEEP + scores * np.sign(
        np.cos(boxes[:, 6] - means[:, motion.HEADING]))
    new.means[i], new.facing[i] = motion.facing_forward(
        means, said, BACKWARDS_BY_KIND[kinds] if fixed else np.full(len(i), np.inf))
    new.covariances[i] = covariances
    gain = states.height_variances[i] / (states.height_variances[i] + HEIGHT_NOISE ** 2)
    new.heights[i] += gain * (boxes[:, 2] - states.heights[i])
    new.height_variances[i] *= 1.0 - gain
    weight = scores / (states.size_weights[i] + scores)
    new.sizes[i] += weight[:, None] * (boxes[:, 3:6] - states.sizes[i])
    new.size_weights[i] = np.minimum(states.size_weights[i] + scores, MAX_SIZE_WEIGHT)
    new.moving[:] = moving(new.means, new.covariances, params.moving_speed)
    _look(new, i, class_ids, scores, params, seconds)
    return new


def _look(new: States, i: np.ndarray, class_ids: np.ndarray, scores: np.ndarray,
          params: TrackingParams, seconds: float) -> None:
    """The evidence of one frame, into arrays of their own."""
    own = params.existence
    missed = np.ones(len(new), bool)
    missed[i] = False
    new.total[missed] += own.missed
    new.looks[:] += 1.0
    new.total[i] += existence.evidence(scores, own)
    new.class_evidence[i, class_ids] += scores
    best = new.class_evidence.argmax(axis=1)
    rows = np.arange(len(new))
    ahead = new.class_evidence[rows, best] > (
        new.class_evidence[rows, new.class_ids] + CLASS_LEAD)
    new.class_ids[ahead] = best[ahead]
    lost = existence.absence(new.hits, new.tries, seconds, own)
    new.present[missed] -= lost[missed]
    new.present[i] = np.minimum(new.present[i] + own.seen, own.max_present)
    new.hits[:] *= KEEP
    new.tries[:] *= KEEP
    new.hits[i] += 1.0
    new.tries[:] += 1.0
    new.unseen[i] = 0.0


def born(first_id: int, boxes: np.ndarray, class_ids: np.ndarray, scores: np.ndarray,
         params: TrackingParams) -> States:
    """New tracks of detections (K, 7), standing as far as is known."""
    count, kinds = len(boxes), KINDS[class_ids]
    noise, heading, speed, turning = (_by_kind(params, name)[kinds] for name in (
        "position", "heading", "first_speed", "turning"))
    means = np.zeros((count, 6))
    means[:, motion.MEASURED] = boxes[:, [0, 1, 6]]
    variances = np.column_stack([noise, noise, speed, speed, heading,
                                 np.where(turning > 0, 0.3, 0.0)]) ** 2
    covariances = np.einsum("ni,ij->nij", variances, np.eye(6))
    own, zeros, ones = params.existence, np.zeros(count), np.ones(count)
    votes = np.zeros((count, len(CLASSES)))
    votes[np.arange(count), class_ids] = scores
    return States(
        first_id + np.arange(count), means, covariances, boxes[:, 2].copy(),
        np.full(count, HEIGHT_NOISE ** 2), boxes[:, 3:6].copy(), scores.copy(), votes,
        class_ids.astype(np.int32), existence.evidence(scores, own), ones,
        np.full(count, own.seen / 2), ones.copy(), ones.copy(),
        moving(means, covariances, params.moving_speed), zeros.copy(), zeros.copy(), scores.copy())


def alive(states: States, params: TrackingParams, fixed: bool) -> States:
    """Those that are still there; of tracks on top of each other the most probable one."""
    states = states.take(np.flatnonzero(
        existence.probability(states.present) >= params.existence.end))
    rank = probabilities(states, params, fixed)
    stays = rotated_nms(states.boxes(), rank, states.class_ids, params.overlap, across_classes=True)
    return states.take(np.sort(stays[:params.max_tracks]))


def probabilities(states: States, params: TrackingParams, fixed: bool) -> np.ndarray:
    """(N,) of being what is claimed, and there. fixed: whether the frame is one in which posts
    stand; if not, motion says nothing."""
    own, still = params.existence, np.zeros(len(states))
    claim = existence.real(states.total, states.looks, states.moving if fixed else still, own)
    if fixed:
        rides = moving(states.means, states.covariances, own.walking)
        rides *= KINDS[states.class_ids] == KIND_OF_CLASS[PEDESTRIAN]
        claim -= own.faster * np.maximum(2.0 * rides - 1.0, 0.0)
    return existence.probability(claim) * existence.probability(states.present)


def moving(means: np.ndarray, covariances: np.ndarray, speed: float) -> np.ndarray:
    """(N,) probability that an object is faster than speed m/s along its velocity, by the
    variance of that."""
    vx, vy = means[:, motion.VX], means[:, motion.VY]
    fast = np.hypot(vx, vy)
    ux, uy = (np.divide(v, fast, out=np.full_like(v, np.sqrt(0.5)), where=fast > 1e-6)
              for v in (vx, vy))
    variance = (ux * ux * covariances[:, 2, 2] + 2 * ux * uy * covariances[:, 2, 3]
                + uy * uy * covariances[:, 3, 3])
    return ndtr((fast - speed) / np.sqrt(np.maximum(variance, 1e-12)))


def _by_kind(params: TrackingParams, name: str) -> np.ndarray:
    return np.array([getattr(kind, name) for kind in params.kinds()])
