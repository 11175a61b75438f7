"""Reader and writer of result files of nuScenes' detection task.

A result file is a JSON file with a list of boxes per key frame.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.boxes import ATTRIBUTES, NAMES, GlobalBoxes, are_valid_rotations, to_global_boxes
from lidar_perception.runs.files import check_regular, shorten_error, write_text
from lidar_perception.types import CLASSES, MAX_NUMBER, Detections, InputError

MAX_BOXES = 500  # maximum number of boxes per frame
# Class of this package -> nuScenes class; nuScenes' bicycles include their riders.
NAME_BY_CLASS = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "bicycle"}
META = {"use_camera": False, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": True}


def to_results(detections: Detections, frame: Frame) -> GlobalBoxes:
    """Convert detections of a frame to global boxes, without velocity and attribute.

    Only classes in NAME_BY_CLASS and the MAX_BOXES boxes with the highest scores are kept. Raises
    InputError if a number is not finite.
    """
    if not (np.isfinite(detections.boxes).all() and np.isfinite(detections.scores).all()):
        raise InputError(f"{frame.name}: a box or score of the detector is not finite; check its weights and its input")
    nuscenes_ids = np.array([NAMES.index(NAME_BY_CLASS[name]) if name in NAME_BY_CLASS else -1 for name in CLASSES])
    class_ids = nuscenes_ids[detections.class_ids]
    indices = np.flatnonzero(class_ids >= 0)
    indices = indices[np.argsort(-detections.scores[indices], kind="stable")][:MAX_BOXES]
    return GlobalBoxes.of(
        *to_global_boxes(detections.boxes[indices], frame.native.pose),
        class_ids[indices],
        scores=detections.scores[indices],
    )


def write_results(path: Path, results: dict[str, GlobalBoxes]) -> None:
    """Write a result file with the boxes by sample token.

    Unknown velocities are written as NaN. nuscenes-devkit scores them as an error of 1, but strict
    JSON parsers reject them.
    """
    rows = {
        token: [
            {
                **box,
                "velocity": velocity,
                "detection_name": NAMES[class_id],
                "detection_score": score,
                "attribute_name": ATTRIBUTES[attribute] if attribute >= 0 else "",
            }
            for box, class_id, attribute, velocity, score in zip(
                format_boxes(token, boxes.centres, boxes.sizes, boxes.rotations),
                *(column.tolist() for column in (boxes.class_ids, boxes.attributes, boxes.velocities, boxes.scores)),
            )
        ]
        for token, boxes in results.items()
    }
    write_text(path, json.dumps({"meta": META, "results": rows}))


def format_boxes(token: str, centres: np.ndarray, sizes: np.ndarray, rotations: np.ndarray) -> list[dict[str, Any]]:
    """Convert the K global boxes of a sample to nuScenes' format (sizes [w l h])."""
    return [
        {"sample_token": token, "translation": centre, "size": [width, length, height], "rotation": rotation}
        for centre, (length, width, height), rotation in zip(centres.tolist(), sizes.tolist(), rotations.tolist())
    ]


def read_results(path: Path, frames: Sequence[Frame]) -> dict[str, GlobalBoxes]:
    """Read the boxes of frames by frame name. Raises InputError if a frame is missing or a box is invalid."""
    try:
        content = json.loads(check_regular(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"cannot read the results {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a JSON file ({shorten_error(error)}); export the results again") from None
    results = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict):
        raise InputError(
            f"{path} has no 'results'; expected the format of nuScenes' "
            'detection task, {"meta": ..., "results": {sample token: [boxes]}}'
        )
    if missing_frames := [f for f in frames if f.native.token not in results]:
        raise InputError(
            f"{path} has no boxes for {missing_frames[0].name}, sample "
            f"{missing_frames[0].native.token} (missing: {len(missing_frames)} of {len(frames)} "
            "frames); add an empty list for a frame without detections, or choose the "
            "scenes to score with --split"
        )
    return {frame.name: _parse_boxes(f"{path}: {frame.name}", results[frame.native.token]) for frame in frames}


def _parse_boxes(source: str, rows: list) -> GlobalBoxes:
    """Parse the boxes of a frame; `source` is the file and frame for error messages."""
    if not isinstance(rows, list) or len(rows) > MAX_BOXES:
        raise InputError(
            f"{source} is not a list of at most {MAX_BOXES} boxes; leave out the boxes with the lowest scores"
        )
    for number, row in enumerate(rows, 1):
        if isinstance(row, dict) and row.get("detection_name", NAMES[0]) not in NAMES:
            raise InputError(
                f"{source}, box {number}: the class {row['detection_name']!r} is not "
                f"one of nuScenes' classes {', '.join(NAMES)}; rename the class or leave out "
                "the box"
            )
    try:
        boxes = GlobalBoxes.of(
            [row["translation"] for row in rows],
            np.array([row["size"] for row in rows], float).reshape(-1, 3)[:, [1, 0, 2]],
            [row["rotation"] for row in rows],
            [NAMES.index(row["detection_name"]) for row in rows],
            [ATTRIBUTES.index(name) if (name := row["attribute_name"]) else -1 for row in rows],
            np.array([row["velocity"] for row in rows], float).reshape(-1, 2),
            [row["detection_score"] for row in rows],
        )
    except KeyError as error:
        raise InputError(
            f"{source}: a box has no {error}; boxes need sample_token, translation, "
            "size, rotation, velocity, detection_name, detection_score and "
            "attribute_name"
        ) from None
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{source}: a box is malformed ({error}); export the results again") from None
    numbers = np.column_stack([boxes.centres, boxes.sizes, boxes.scores])
    is_invalid = ~(
        (np.abs(numbers) <= MAX_NUMBER).all(axis=1)
        & (boxes.sizes > 0).all(axis=1)
        & are_valid_rotations(boxes.rotations)
        & ~(np.abs(boxes.velocities) > MAX_NUMBER).any(axis=1)
    )
    if is_invalid.any():
        raise InputError(
            f"{source}, box {np.flatnonzero(is_invalid)[0]}: translation, size, rotation "
            f"and score must be finite and within {MAX_NUMBER:g}, sizes must be positive, the "
            "rotation must be a quaternion, and the velocity finite or NaN"
        )
    return boxes
