"""Result files of nuScenes' detection task: one JSON file with a list of boxes per key frame."""

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
# Our class -> nuScenes name; bicycles of nuScenes include their riders.
NAME_BY_CLASS = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "bicycle"}
META = {"use_camera": False, "use_lidar": True, "use_radar": False, "use_map": False, "use_external": True}


def to_results(detections: Detections, frame: Frame) -> GlobalBoxes:
    """Convert detections of a frame to global boxes, without velocity and attribute.

    Keeps only classes in NAME_BY_CLASS, and at most the MAX_BOXES boxes with the highest scores.
    Raises InputError if a number is not finite.
    """
    if not (np.isfinite(detections.boxes).all() and np.isfinite(detections.scores).all()):
        raise InputError(
            f"{frame.name}: a box or score of the detector is not finite; its weights or its input are broken"
        )
    class_id_by_ours = np.array([NAMES.index(NAME_BY_CLASS[name]) if name in NAME_BY_CLASS else -1 for name in CLASSES])
    class_ids = class_id_by_ours[detections.class_ids]
    selected = np.flatnonzero(class_ids >= 0)
    selected = selected[np.argsort(-detections.scores[selected], kind="stable")][:MAX_BOXES]
    return GlobalBoxes.of(
        *to_global_boxes(detections.boxes[selected], frame.native.pose),
        class_ids[selected],
        scores=detections.scores[selected],
    )


def write_results(path: Path, results: dict[str, GlobalBoxes]) -> None:
    """Write the boxes by sample token.

    Unknown velocities are NaN, which nuscenes-devkit scores as an error of 1, but strict JSON
    parsers reject.
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
    """Read the boxes of frames, by frame name. InputError for missing frames or invalid boxes."""
    try:
        content = json.loads(check_regular(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"cannot read the results {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not a JSON file ({shorten_error(error)}); write the results again") from None
    results = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict):
        raise InputError(
            f"{path} has no 'results'; it needs them in the format of nuScenes' "
            'detection task: {"meta": ..., "results": {sample token: [boxes]}}'
        )
    if missing := [f for f in frames if f.native.token not in results]:
        raise InputError(
            f"{path} has no boxes for {missing[0].name}, sample "
            f"{missing[0].native.token} (missing: {len(missing)} of {len(frames)} "
            "frames); a frame without detections needs an empty list, and --split "
            "selects the scenes to score"
        )
    return {frame.name: _parse_boxes(f"{path}: {frame.name}", results[frame.native.token]) for frame in frames}


def _parse_boxes(where: str, rows: list) -> GlobalBoxes:
    if not isinstance(rows, list) or len(rows) > MAX_BOXES:
        raise InputError(f"{where} needs a list of at most {MAX_BOXES} boxes; leave out those with the lowest scores")
    for number, row in enumerate(rows, 1):
        if isinstance(row, dict) and row.get("detection_name", NAMES[0]) not in NAMES:
            raise InputError(
                f"{where}, box {number}: the class {row['detection_name']!r} is not "
                f"one of nuScenes' classes {', '.join(NAMES)}; rename or leave out "
                "such boxes"
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
            f"{where}: a box has no {error}; boxes need sample_token, translation, "
            "size, rotation, velocity, detection_name, detection_score and "
            "attribute_name"
        ) from None
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where}: a box is malformed ({error}); write the results again") from None
    numbers = np.column_stack([boxes.centres, boxes.sizes, boxes.scores])
    invalid = ~(
        (np.abs(numbers) <= MAX_NUMBER).all(axis=1)
        & (boxes.sizes > 0).all(axis=1)
        & are_valid_rotations(boxes.rotations)
        & ~(np.abs(boxes.velocities) > MAX_NUMBER).any(axis=1)
    )
    if invalid.any():
        raise InputError(
            f"{where}, box {np.flatnonzero(invalid)[0]}: translation, size, rotation "
            f"and score must be finite and within {MAX_NUMBER:g}, sizes above 0, the "
            "rotation a quaternion, and the velocity finite or NaN"
        )
    return boxes
