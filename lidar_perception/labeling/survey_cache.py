"""The survey of a drive in a file, so that a server that is started again has it at once."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from lidar_perception import __version__
from lidar_perception.labeling.drive import Drive
from lidar_perception.labeling.journal import header
from lidar_perception.labeling.survey import Look
from lidar_perception.runs.files import short, write_bytes
from lidar_perception.types import Detections, InputError

Array = np.ndarray[Any, Any]
NAME, LAYOUT = "survey.npz", 1
MOST_BYTES = 300 * 10**6  # of such a file; the looks of 1,000 frames take a tenth of it
PARTS = "detections", "classes", "scores", "boxes", "images", "features", "things"


def key_of(drive: Drive, weights: str) -> str:
    """What a survey depends on: the drive, the weights, the version of the package."""
    head = header(drive.name, [f.name for f in drive.frames], [f.stamp_ns for f in drive.frames])
    file = Path(weights)
    content = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
    return json.dumps({**head, "layout": LAYOUT, "weights": weights, "content": content,
                       "version": __version__, "posed": drive.motion.poses is not None})


def write(path: Path, key: str, looks: Sequence[Look]) -> None:
    """Keep the looks of a drive's frames. InputError where they cannot be written, or are more than
    MOST_BYTES."""
    columns: list[list[Array]] = [[] for _ in PARTS]
    names = sorted({name for look in looks for name in look.features})
    for look in looks:
        found = look.detections
        features = np.array([look.features.get(n, np.zeros(len(look.boxes))) for n in names])
        for column, part in zip(columns, (
                found.boxes, found.class_ids, found.scores, look.boxes, look.images,
                features.reshape(len(names), -1).T, look.things)):
            column.append(part)
    arrays: dict[str, Any] = {}
    for name, column in zip(PARTS, columns):
        arrays[name] = np.concatenate(column)
        arrays[f"{name}_counts"] = np.array([len(part) for part in column])
    poses = [look.pose for look in looks if look.pose is not None]
    content = io.BytesIO()
    np.savez_compressed(content, key=np.array(key), names=np.array(names, str),
                        poses=np.array(poses), **arrays)
    if content.getbuffer().nbytes > MOST_BYTES:
        raise InputError(f"the survey has more than {MOST_BYTES / 1e6:.0f} MB and is not kept")
    write_bytes(path, content.getbuffer())


def read(path: Path, key: str) -> list[Look] | None:
    """The looks that were kept; None where there are none, or they are of something else.
    InputError for a file that is damaged."""
    if not path.is_file():
        return None
    try:
        with np.load(path) as file:
            if str(file["key"]) != key:
                return None
            names = [str(name) for name in file["names"]]
            poses = file["poses"]
            parts = [np.split(file[name], np.cumsum(file[f"{name}_counts"])[:-1])
                     for name in PARTS]
        return [Look(Detections(boxes, classes, scores), clusters, images,
                     dict(zip(names, features.T)) if len(clusters) else {}, things,
                     poses[i] if len(poses) else None)
                for i, (boxes, classes, scores, clusters, images, features, things)
                in enumerate(zip(*parts, strict=True))]
    except (OSError, ValueError, TypeError, KeyError, EOFError, BadZipFile) as error:
        raise InputError(f"{path} is damaged ({short(error)}); the drive is looked at "
                         "again") from None
