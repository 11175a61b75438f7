"""Labels and tracks of one frame for the tracking scores, and their similarity.

As in KITTI's tracking benchmark (TrackEval), labels of neighbour classes, truncated or hardly
visible labels, DontCare regions and small boxes are ignored. Labels outside the image are also
ignored; KITTI has no such labels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from lidar_perception.camera import Calibration
from lidar_perception.classes import DETECTED
from lidar_perception.geometry import iou_3d
from lidar_perception.scoring.kitti.camera_objects import CameraObjects, to_camera_objects
from lidar_perception.scoring.kitti.protocol import EPS, NEIGHBOURS, compute_image_iou
from lidar_perception.types import CLASSES, Detections, GroundTruth, InputError

MAX_OCCLUSION, MAX_TRUNCATION = 2, 0  # maximum levels in KITTI's tracking labels
MIN_HEIGHT = 25.0  # minimum height of the 2D box in pixels
MAX_DONT_CARE_FRACTION = 0.5  # maximum fraction of a box inside a DontCare region
MAX_CENTRE_DISTANCE = 2.0  # distance of centres in metres at which the similarity becomes 0
MIN_SIMILARITY = 0.5  # minimum similarity of a match in CLEAR MOT and of a match with an ignored label


@dataclass(frozen=True)
class Pairs:
    """M labels of a class and its neighbour class, and K tracks of the class, in one frame.

    Attributes:
        true_ids: (M,) int64, unique track ids of the labels.
        is_ignored: (M,) bool, True for labels that need not be detected.
        track_ids: (K,) int64, unique ids of the tracks.
        scores: (K,) float64 scores of the tracks.
        is_excused: (K,) bool, True for tracks that are not false positives if they match no label.
        similarity: (M, K) float64 0..1, 1 - distance of the centres / MAX_CENTRE_DISTANCE, for HOTA and
            CLEAR MOT.
        overlap: (M, K) float64 3D IoU, for AB3DMOT's scores.
    """

    true_ids: np.ndarray
    is_ignored: np.ndarray
    track_ids: np.ndarray
    scores: np.ndarray
    is_excused: np.ndarray
    similarity: np.ndarray
    overlap: np.ndarray


def to_tracked_labels(ids: np.ndarray, detections: Detections) -> GroundTruth:
    """Convert K tracked detections with these ids (K,) to labels with track_id and score."""
    return GroundTruth.of(
        detections.boxes,
        detections.class_ids,
        [{"track_id": int(i), "score": float(s)} for i, s in zip(ids, detections.scores)],
    )


def make_pairs(truth: GroundTruth, tracks: GroundTruth, calibration: Calibration | None) -> dict[str, Pairs]:
    """Make the pairs of one frame by class.

    Args:
        truth: Labels with a track_id in extras.
        tracks: Tracks as labels with a track_id and score in extras.
        calibration: Camera calibration. With None, box heights and DontCare regions are not used.

    Raises:
        InputError: A track id is missing or duplicate, or a number is not finite.
    """
    true_ids, track_ids = read_track_ids(truth, "label"), read_track_ids(tracks, "track")
    camera_labels, camera_tracks = (to_camera_objects(objects, calibration) for objects in (truth, tracks))
    # Labels without a 3D box come last. They are DontCare regions and are also listed in .regions.
    labels_3d, tracks_3d = (camera_labels.take(np.arange(len(truth))), camera_tracks.take(np.arange(len(tracks))))
    is_ignored = np.array(
        [
            extra.get("occluded", 0) > MAX_OCCLUSION or round(extra.get("truncated", 0)) > MAX_TRUNCATION
            for extra in truth.extras
        ],
        bool,
    )
    is_ignored |= labels_3d.pixels_high == 0
    dont_care_fraction = compute_image_iou(tracks_3d.image_boxes, camera_labels.regions, over_first=True)
    is_excused = (tracks_3d.pixels_high <= MIN_HEIGHT + EPS) | (dont_care_fraction > MAX_DONT_CARE_FRACTION + EPS).any(
        axis=1
    )
    return {
        name: _make_class_pairs(name, labels_3d, tracks_3d, true_ids, track_ids, is_ignored, is_excused)
        for name in DETECTED
    }


def read_track_ids(objects: GroundTruth, noun: str) -> np.ndarray:
    """Read the track ids (N,) int64.

    Args:
        objects: N labels or tracks.
        noun: Name of the objects in error messages.

    Raises:
        InputError: An id is missing (-1 in KITTI) or duplicate.
    """
    ids = np.array([extra.get("track_id", -1) for extra in objects.extras], np.int64)
    if (ids < 0).any():
        raise InputError(f"a {noun} has no track id; tracking scores require an id for every {noun}")
    if len(np.unique(ids)) < len(ids):
        raise InputError(f"a frame contains the {noun} id {np.sort(ids)[:-1][np.diff(np.sort(ids)) == 0][0]} twice")
    return ids


def _make_class_pairs(
    name: str,
    camera_labels: CameraObjects,
    camera_tracks: CameraObjects,
    true_ids: np.ndarray,
    track_ids: np.ndarray,
    is_ignored: np.ndarray,
    is_excused: np.ndarray,
) -> Pairs:
    class_id, neighbour_id = CLASSES.index(name), CLASSES.index(NEIGHBOURS.get(name, name))
    rows = np.flatnonzero(np.isin(camera_labels.class_ids, [class_id, neighbour_id]))
    columns = np.flatnonzero(camera_tracks.class_ids == class_id)
    labels, tracks = camera_labels.take(rows), camera_tracks.take(columns)
    distance = np.linalg.norm(labels.boxes[:, None, :3] - tracks.boxes[None, :, :3], axis=2)
    return Pairs(
        true_ids[rows],
        is_ignored[rows] | (labels.class_ids != class_id),
        track_ids[columns],
        tracks.scores,
        is_excused[columns],
        np.maximum(1.0 - distance / MAX_CENTRE_DISTANCE, 0.0),
        iou_3d(labels.boxes, tracks.boxes),
    )


def drop_ignored(pairs: Pairs) -> Pairs:
    """Drop the pairs that HOTA and CLEAR MOT ignore.

    These are ignored labels, tracks that match one of them, and excused tracks without a match.
    """
    rows, columns = find_best_pairs(np.where(pairs.similarity < MIN_SIMILARITY - EPS, 0.0, pairs.similarity))
    is_dropped = pairs.is_excused.copy()
    is_dropped[columns] = pairs.is_ignored[rows]
    labels, tracks = np.flatnonzero(~pairs.is_ignored), np.flatnonzero(~is_dropped)
    kept_pairs = np.ix_(labels, tracks)
    return replace(
        pairs,
        true_ids=pairs.true_ids[labels],
        is_ignored=pairs.is_ignored[labels],
        track_ids=pairs.track_ids[tracks],
        scores=pairs.scores[tracks],
        is_excused=pairs.is_excused[tracks],
        similarity=pairs.similarity[kept_pairs],
        overlap=pairs.overlap[kept_pairs],
    )


def find_best_pairs(gain: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Assign the rows of a gain matrix (M, K) to columns so that the total gain is maximal.

    Returns:
        Rows (P,) and columns (P,) of the pairs with a positive gain.
    """
    rows, columns = linear_sum_assignment(gain, maximize=True)
    has_gain = gain[rows, columns] > EPS
    return rows[has_gain], columns[has_gain]
