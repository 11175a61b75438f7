"""Disk cache of the survey of a drive, so that a restarted server does not repeat it."""

from __future__ import annotations

import hashlib
import io
import json
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from lidar_perception import __version__
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.files import shorten_error, write_bytes
from lidar_perception.runs.resuming import find_differences
from lidar_perception.types import Detections
from lidar_studio.drive import Drive
from lidar_studio.survey import FrameSurvey

Array = np.ndarray[Any, Any]
FOLDER, LAYOUT = "survey", 2
FRAMES_PER_FILE = 20
PARTS = "detections", "classes", "scores", "boxes", "images", "features", "things"


def make_key(drive: Drive, choice: DetectorChoice | None) -> str:
    """Return a JSON string with all inputs of a survey: drive, weights, parameters and package version."""
    weights = "" if choice is None else choice.weights
    file = Path(weights)
    parameters = (
        {} if choice is None else {**({} if choice.range == "auto" else {"range": choice.range}), **choice.settings}
    )
    content = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
    return json.dumps(
        {
            **drive.journal_header,
            "layout": LAYOUT,
            "weights": weights,
            "content": content[:16],
            "version": __version__,
            **({"settings": parameters} if parameters else {}),
            "posed": drive.motion.poses is not None,
        }
    )


def clear(folder: Path) -> None:
    """Remove all files of a cache."""
    for path in folder.glob("*.npz"):
        path.unlink(missing_ok=True)


def write(folder: Path, key: str, first: int, surveys: Sequence[FrameSurvey]) -> None:
    """Write one file of a cache.

    Args:
        first: Index of the first frame in the file.
        surveys: Surveys of FRAMES_PER_FILE frames, or fewer at the end of the drive.

    Raises:
        InputError: The file cannot be written.
    """
    columns: list[list[Array]] = [[] for _ in PARTS]
    names = sorted({name for survey in surveys for name in survey.features})
    for survey in surveys:
        detections = survey.detections
        features = np.array([survey.features.get(n, np.zeros(len(survey.boxes))) for n in names])
        for column, part in zip(
            columns,
            (
                detections.boxes,
                detections.class_ids,
                detections.scores,
                survey.boxes,
                survey.images,
                features.reshape(len(names), -1).T,
                survey.shapes,
            ),
        ):
            column.append(part)
    arrays: dict[str, Any] = {}
    for name, column in zip(PARTS, columns):
        arrays[name] = np.concatenate(column)
        arrays[f"{name}_counts"] = np.array([len(part) for part in column])
    poses = [survey.pose for survey in surveys if survey.pose is not None]
    content = io.BytesIO()
    np.savez_compressed(content, key=np.array(key), names=np.array(names, str), poses=np.array(poses), **arrays)
    write_bytes(folder / _get_file_name(first), content.getbuffer())


def _get_file_name(first: int) -> str:
    return f"{first:06}.npz"


def read(folder: Path, key: str) -> tuple[list[FrameSurvey], str]:
    """Return the cached surveys of the first frames, and a message if other cached surveys were ignored."""
    surveys: list[FrameSurvey] = []
    first = 0
    while (path := folder / _get_file_name(first)).is_file():
        try:
            with np.load(path) as file:
                stored_key = str(file["key"])
                surveys += _read_file(file) if stored_key == key else []
            if stored_key != key:
                differences = "; ".join(find_differences(json.loads(stored_key), json.loads(key)))
                return [], (f"{folder} belongs to another survey ({differences}); the drive is surveyed again")
        except (OSError, ValueError, TypeError, KeyError, AttributeError, EOFError, BadZipFile, zlib.error) as error:
            return surveys, (
                f"{path} is damaged ({shorten_error(error)}); the drive is surveyed again from frame {first} on"
            )
        first += FRAMES_PER_FILE
    return surveys, ""


def _read_file(file: Any) -> list[FrameSurvey]:
    names, poses = [str(name) for name in file["names"]], file["poses"]
    parts = [np.split(file[name], np.cumsum(file[f"{name}_counts"])[:-1]) for name in PARTS]
    return [
        FrameSurvey(
            Detections(boxes, classes, scores),
            clusters,
            images,
            dict(zip(names, features.T)) if len(clusters) else {},
            shapes,
            poses[i] if len(poses) else None,
        )
        for i, (boxes, classes, scores, clusters, images, features, shapes) in enumerate(zip(*parts, strict=True))
    ]
