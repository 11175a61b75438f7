"""Plain implementation of paper A with scikit-learn, OpenCV and NumPy, to compare our pipeline with.

Where the paper is ambiguous, it makes the same choice as our pipeline. It shares only the camera
matrix with our code.
"""

from __future__ import annotations

from time import perf_counter

import cv2
import numpy as np
from sklearn.cluster import DBSCAN
from sklearn.linear_model import LinearRegression, RANSACRegressor

BANDS = ((0.0, 15.0, 0.15), (15.0, 30.0, 0.30), (30.0, np.inf, 0.50))
MIN_SAMPLES, Z_MAX, INLIER, TRIALS = 10, -1.3, 0.1, 2000
HEIGHT_TOLERANCE, TAU, ROWS, COLUMNS = 0.2, 0.40, 80, 32
CPA_RANGE, CPA_STEPS, CPA_DECREMENT, CPA_MIN = (15.0, 30.0), 2, 0.10, 0.20
KERNEL = np.ones((3, 3), np.uint8)


def find_candidates(
    xyz: np.ndarray,
    projection: np.ndarray,
    width: int,
    height: int,
    pedestrians: np.ndarray,
    ground: np.ndarray | None = None,
) -> dict:
    """Find candidates in a cloud.

    Args:
        xyz: (N, 3) points.
        projection, width, height: Projection matrix and image size of the camera.
        pedestrians: (M, 7) labelled pedestrians.
        ground: Mask of the ground among the points in view; None to find it by RANSAC.

    Returns:
        Points in view, ground, labels, boxes (K, 7) of each stage, and ms of each step.
    """
    times = [perf_counter()]
    homogeneous = np.column_stack([xyz, np.ones(len(xyz))]) @ projection.T
    depth = homogeneous[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = homogeneous[:, 0] / depth, homogeneous[:, 1] / depth
    points = xyz[(depth > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)]
    times.append(perf_counter())

    low = points[:, 2] < Z_MAX
    if ground is None:
        ransac = RANSACRegressor(LinearRegression(), max_trials=TRIALS, residual_threshold=INLIER, random_state=0).fit(
            points[low, :2], points[low, 2]
        )
        distances_to_plane = np.abs(points[:, 2] - ransac.predict(points[:, :2]))
        ground = low & (distances_to_plane <= INLIER)
    plane = LinearRegression().fit(points[ground, :2], points[ground, 2])
    times.append(perf_counter())

    labels = np.full(len(points), -1)
    distance = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2)
    for low_range, high_range, eps in BANDS:
        band = ~ground & (distance >= low_range) & (distance < high_range)
        if band.sum() == 0:
            continue
        band_labels = DBSCAN(eps=eps, min_samples=MIN_SAMPLES).fit(points[band]).labels_
        labels[band] = np.where(band_labels >= 0, band_labels + labels.max() + 1, -1)
    clusters = [points[labels == k] for k in range(labels.max() + 1)]
    times.append(perf_counter())

    boxes = np.array([_fit_box(c, plane) for c in clusters]).reshape(-1, 7)
    times.append(perf_counter())

    seed_box = pedestrians[np.argmin(np.hypot(pedestrians[:, 0], pedestrians[:, 1]))]
    seed = points[~ground][_is_inside(points[~ground], seed_box)]
    stage1 = [k for k in range(len(boxes)) if abs(boxes[k, 5] - seed_box[5]) <= HEIGHT_TOLERANCE]
    times.append(perf_counter())
    template = _draw_silhouette(seed, 0)
    stm_scores = {k: _compute_cosine(_draw_silhouette(clusters[k], 0), template) for k in stage1}
    times.append(perf_counter())
    cpa_scores = dict(stm_scores)
    for k in stage1:
        if CPA_RANGE[0] <= np.hypot(boxes[k, 0], boxes[k, 1]) < CPA_RANGE[1]:
            cpa_scores[k] = _compute_cosine(_draw_silhouette(clusters[k], CPA_STEPS), template)
    times.append(perf_counter())

    steps = ("view", "ground", "clustering", "boxes", "height", "stm", "cpa")
    return {
        "points": points,
        "ground": ground,
        "labels": labels + 1,
        "stage1": boxes[stage1],
        "stage2": boxes[[k for k in stage1 if stm_scores[k] >= TAU]],
        "final": boxes[[k for k in stage1 if cpa_scores[k] >= TAU]],
        "ms": {s: 1e3 * (b - a) for s, a, b in zip(steps, times, times[1:])},
    }


def _fit_box(cluster: np.ndarray, plane: LinearRegression) -> list[float]:
    low, high = cluster.min(axis=0), cluster.max(axis=0)
    centre = (low + high) / 2
    bottom = min(low[2], plane.predict(centre[None, :2])[0])
    return [*centre[:2], (bottom + high[2]) / 2, *(high - low)[:2], high[2] - bottom, 0.0]


def _is_inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    offset = points - box[:3]
    x = offset[:, 0] * np.cos(box[6]) + offset[:, 1] * np.sin(box[6])
    y = offset[:, 1] * np.cos(box[6]) - offset[:, 0] * np.sin(box[6])
    return (np.abs(x) <= box[3] / 2) & (np.abs(y) <= box[4] / 2) & (np.abs(offset[:, 2]) <= box[5] / 2)


def _draw_silhouette(cluster: np.ndarray, steps: int) -> np.ndarray:
    cluster = cluster.astype(float)
    centroid = cluster.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov(cluster[:, :2].T))
    lateral = axes[:, 1]
    if lateral @ [-centroid[1], centroid[0]] < 0:  # the axis points to the left, seen from the sensor
        lateral = -lateral
    y, z = (cluster - centroid)[:, :2] @ lateral, cluster[:, 2] - centroid[2]
    scales = [1.0] + [max(CPA_MIN, 1 - k * CPA_DECREMENT) for k in range(1, steps + 1)]
    all_y = np.concatenate([s * y for s in scales])
    all_z = np.concatenate([s * z for s in scales])
    columns = (all_y - y.min()) / max(np.ptp(y), 1e-6) * COLUMNS
    rows = (z.max() - all_z) / max(np.ptp(z), 1e-6) * ROWS
    image = np.zeros((ROWS, COLUMNS), np.uint8)
    image[np.minimum(rows.astype(int), ROWS - 1), np.minimum(columns.astype(int), COLUMNS - 1)] = 1
    closed_image = cv2.morphologyEx(image, cv2.MORPH_CLOSE, KERNEL)
    return cv2.dilate(closed_image, KERNEL).ravel().astype(float)


def _compute_cosine(a: np.ndarray, b: np.ndarray) -> float:
    return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
