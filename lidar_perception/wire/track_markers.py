"""Markers of tracks: boxes with stable ids, velocity arrows, labels and trails."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from lidar_perception.types import CLASSES, Detections
from lidar_perception.wire.messages import MAX_ID
from msg_utils.markers import ADD, COLORS, OTHER_COLOR, MarkerRow, list_marker_keys, make_marker_rows

ARROW, LINE_STRIP, TEXT = 0, 4, 9
# Namespaces in addition to those named after the classes.
VELOCITY, TRAIL, NUMBER = EXTRA_NAMESPACES = "velocity", "trail", "number"
MIN_ARROW_PROBABILITY = 0.5  # minimum probability of motion for a velocity arrow


def make_track_rows(
    ids: np.ndarray,
    detections: Detections,
    velocities: np.ndarray,
    moving: np.ndarray,
    trails: Sequence[np.ndarray],
    *,
    extras: Sequence[dict[str, Any]] | None = None,
    previous: Iterable[tuple[str, int]] = (),
) -> list[MarkerRow]:
    """Make the markers of K tracks.

    The boxes are those of make_detection_rows; their texts also contain the velocity, the
    probability of motion and the extras. Under the same ids, the namespaces EXTRA_NAMESPACES
    contain an arrow to the position in one second, the trail, and a label with number and speed.

    Args:
        ids: (K,) track ids.
        velocities: (K, 2) m/s.
        moving: (K,) probabilities of motion.
        trails: K arrays (N, 3) of past positions; a trail with one point is not drawn.
        extras: K dicts to add to the texts.
        previous: Keys of the previous array, see to_marker_array.
    """
    numbers: list[int] = (np.asarray(ids) % MAX_ID).tolist()
    labels, boxes = [CLASSES[i] for i in detections.class_ids], detections.boxes.astype(float)
    texts = [
        {
            "id": i,
            "velocity": [round(float(v), 3) for v in velocity],
            "moving": round(float(p), 3),
            **(extras[k] if extras is not None else {}),
        }
        for k, (i, velocity, p) in enumerate(zip(numbers, velocities, moving))
    ]
    tops = boxes[:, :3] + boxes[:, 5:6] / 2 * [[0.0, 0.0, 1.0]]
    arrow_tips = tops + np.pad(np.reshape(velocities, (-1, 2)), ((0, 0), (0, 1)))
    captions = (tops + [0.0, 0.0, 0.5]).tolist()
    extra_rows = []
    for k, (i, label, p, trail) in enumerate(zip(numbers, labels, moving, trails, strict=True)):
        color, has_arrow = (*COLORS.get(label, OTHER_COLOR), 1.0), p >= MIN_ARROW_PROBABILITY
        speed = f"  {np.hypot(*velocities[k]):.1f} m/s" if has_arrow else ""
        extra_rows.append(
            MarkerRow(
                NUMBER, i, type=TEXT, text=f"{i}{speed}", color=color, position=captions[k], scale=(0.0, 0.0, 0.6)
            )
        )
        if has_arrow:
            extra_rows.append(
                MarkerRow(
                    VELOCITY,
                    i,
                    type=ARROW,
                    scale=(0.1, 0.25, 0.3),
                    color=color,
                    points=np.stack([tops[k], arrow_tips[k]]),
                )
            )
        if len(trail) > 1:
            extra_rows.append(MarkerRow(TRAIL, i, type=LINE_STRIP, scale=(0.08, 0.0, 0.0), color=color, points=trail))
    extra_keys = list_marker_keys(extra_rows)
    return (
        make_marker_rows(
            boxes, labels, detections.scores, ids=numbers, extras=texts, previous=set(previous) - extra_keys
        )
        + extra_rows
    )


def read_trails(msg: Any) -> dict[int, np.ndarray]:
    """Return {track id: trail (N, 3) float64} from a MarkerArray."""
    return {
        int(m.id): np.array([[p.x, p.y, p.z] for p in m.points], np.float64)
        for m in msg.markers
        if m.ns == TRAIL and m.action == ADD
    }
