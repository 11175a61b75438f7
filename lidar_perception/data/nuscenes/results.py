"""Result files of nuScenes' detection task: one JSON file, a list of boxes for each key frame."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.boxes import ATTRIBUTES, NAMES, GlobalBoxes, in_global, usable
from lidar_perception.runs.files import regular, short, write_text
from lidar_perception.types import CLASSES, LARGEST, Detections, InputError

MAX_BOXES = 500    # of a frame
# The classes of our detectors in the words of nuScenes; its bicycles have their riders inside.
DETECTED = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "bicycle"}
META = {"use_camera": False, "use_lidar": True, "use_radar": False, "use_map": False,
        "use_external": True}


def to_results(detections: Detections, frame: Frame) -> GlobalBoxes:
    """Detections of a frame as nuScenes has them, without a velocity and an attribute. Only the
    classes in DETECTED, and the best MAX_BOXES of them. InputError for numbers that are not
    finite."""
    if not (np.isfinite(detections.boxes).all() and np.isfinite(detections.scores).all()):
        raise InputError(f"{frame.name}: a box or score of the detector is not finite; its weights "
                         "or its input are broken")
    theirs = np.array([NAMES.index(DETECTED[name]) if name in DETECTED else -1 for name in CLASSES])
    class_ids = theirs[detections.class_ids]
    chosen = np.flatnonzero(class_ids >= 0)
    chosen = chosen[np.argsort(-detections.scores[chosen], kind="stable")][:MAX_BOXES]
    return GlobalBoxes.of(*in_global(detections.boxes[chosen], frame.native.pose),
                          class_ids[chosen], scores=detections.scores[chosen])


def write_results(path: Path, results: dict[str, GlobalBoxes]) -> None:
    """Write the boxes by sample token. A velocity that is not known is NaN, which nuscenes-devkit
    reads, and judges with an error of 1; strict readers of JSON do not."""
    rows = {token: [{
        **place, "velocity": velocity, "detection_name": NAMES[class_id],
        "detection_score": score, "attribute_name": ATTRIBUTES[attribute] if attribute >= 0 else ""}
        for place, class_id, attribute, velocity, score in zip(
            places(token, boxes.centres, boxes.sizes, boxes.rotations),
            *(column.tolist() for column in (boxes.class_ids, boxes.attributes, boxes.velocities,
                                             boxes.scores)))]
        for token, boxes in results.items()}
    write_text(path, json.dumps({"meta": META, "results": rows}))


def places(token: str, centres: np.ndarray, sizes: np.ndarray,
           rotations: np.ndarray) -> list[dict[str, Any]]:
    """Where K boxes of a sample are, as its files have it: centres (K, 3), sizes (K, 3) [l w h] and
    rotations (K, 4) [w x y z] as of in_global; their sizes are [w l h]."""
    return [{"sample_token": token, "translation": centre, "size": [width, length, height],
             "rotation": rotation}
            for centre, (length, width, height), rotation in zip(
                centres.tolist(), sizes.tolist(), rotations.tolist())]


def read_results(path: Path, frames: Sequence[Frame]) -> dict[str, GlobalBoxes]:
    """The boxes of each frame by its name; those of other frames are left out. InputError names the
    frame that is missing and the box that is wrong."""
    try:
        content = json.loads(regular(path).read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"cannot read the results {path}: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is no JSON file ({short(error)}); write the results again"
                         ) from None
    results = content.get("results") if isinstance(content, dict) else None
    if not isinstance(results, dict):
        raise InputError(f"{path} has no 'results'; it needs them in the format of nuScenes' "
                         "detection task: {\"meta\": ..., \"results\": {sample token: [boxes]}}")
    if missing := [f for f in frames if f.native.token not in results]:
        raise InputError(f"{path} has no boxes of {missing[0].name}, sample "
                         f"{missing[0].native.token} ({len(missing)} of {len(frames)} such); a "
                         "frame without detections needs an empty list, and --split says which "
                         "scenes to score")
    return {frame.name: _boxes(f"{path}: {frame.name}", results[frame.native.token])
            for frame in frames}


def _boxes(where: str, rows: list) -> GlobalBoxes:
    if not isinstance(rows, list) or len(rows) > MAX_BOXES:
        raise InputError(f"{where}, needs a list of at most {MAX_BOXES} boxes; leave out those of "
                         "the lowest scores")
    for number, row in enumerate(rows, 1):
        if isinstance(row, dict) and row.get("detection_name", NAMES[0]) not in NAMES:
            raise InputError(f"{where}, box {number}: the class {row['detection_name']!r} is none "
                             f"of nuScenes' {', '.join(NAMES)}; rename or leave out such boxes")
    try:
        boxes = GlobalBoxes.of(
            [row["translation"] for row in rows],
            np.array([row["size"] for row in rows], float).reshape(-1, 3)[:, [1, 0, 2]],
            [row["rotation"] for row in rows],
            [NAMES.index(row["detection_name"]) for row in rows],
            [ATTRIBUTES.index(name) if (name := row["attribute_name"]) else -1 for row in rows],
            np.array([row["velocity"] for row in rows], float).reshape(-1, 2),
            [row["detection_score"] for row in rows])
    except KeyError as error:
        raise InputError(f"{where}: a box has no {error}; boxes need sample_token, translation, "
                         "size, rotation, velocity, detection_name, detection_score and "
                         "attribute_name") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where}: a box that cannot be read ({error}); write the results "
                         "again") from None
    numbers = np.column_stack([boxes.centres, boxes.sizes, boxes.scores])
    wrong = ~((np.abs(numbers) <= LARGEST).all(axis=1) & (boxes.sizes > 0).all(axis=1)
              & usable(boxes.rotations) & ~(np.abs(boxes.velocities) > LARGEST).any(axis=1))
    if wrong.any():
        raise InputError(f"{where}, box {np.flatnonzero(wrong)[0]}: translation, size, rotation "
                         f"and score must be finite and within {LARGEST:g}, sizes above 0, the "
                         "rotation a quaternion, and the velocity finite or NaN")
    return boxes
