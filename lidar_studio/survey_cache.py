"""The survey of a drive in files, a piece each, so that a server that is started again has it at
once, or goes on where the other one ended."""

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
from lidar_perception.types import Detections, InputError
from lidar_studio.drive import Drive
from lidar_studio.survey import Look

Array = np.ndarray[Any, Any]
FOLDER, LAYOUT = "survey", 2
PIECE = 20                # frames of a file
MOST_BYTES = 300 * 10**6  # of all; the looks of 1,000 frames take a tenth of it
PARTS = "detections", "classes", "scores", "boxes", "images", "features", "things"


def key_of(drive: Drive, choice: DetectorChoice | None) -> str:
    """Return what a survey depends on: the drive, the detector with its weights and parameters,
    and the version of the package."""
    weights = "" if choice is None else choice.weights
    file = Path(weights)
    asked = {} if choice is None else {
        **({} if choice.range == "auto" else {"range": choice.range}), **choice.settings}
    content = hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else ""
    return json.dumps({**drive.known_by, "layout": LAYOUT,
                       "weights": weights, "content": content[:16], "version": __version__,
                       **({"settings": asked} if asked else {}),
                       "posed": drive.motion.poses is not None})


def clear(folder: Path) -> None:
    """Remove all pieces."""
    for path in folder.glob("*.npz"):
        path.unlink(missing_ok=True)


def write(folder: Path, key: str, first: int, looks: Sequence[Look]) -> None:
    """Keep a piece, the looks of a drive's frames from `first` on, PIECE of them but at the end.
    InputError where it cannot be written, or all are more than MOST_BYTES."""
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
    size = content.getbuffer().nbytes + sum(p.stat().st_size for p in folder.glob("*.npz"))
    if size > MOST_BYTES:
        raise InputError(f"what is seen has more than {MOST_BYTES / 1e6:.0f} MB, and is kept up to "
                         f"frame {first} only")
    write_bytes(folder / _named(first), content.getbuffer())


def _named(first: int) -> str:
    return f"{first:06}.npz"


def read(folder: Path, key: str) -> tuple[list[Look], str]:
    """The looks that were kept, from the first frame on, and why they are not all of those that
    are there, or ""."""
    looks: list[Look] = []
    first = 0
    while (path := folder / _named(first)).is_file():
        try:
            with np.load(path) as file:
                found = str(file["key"])
                looks += _looks(file) if found == key else []
            if found != key:
                other = "; ".join(find_differences(json.loads(found), json.loads(key)))
                return [], (f"{folder} is of something else ({other}); the drive is looked at "
                            "again")
        except (OSError, ValueError, TypeError, KeyError, AttributeError, EOFError, BadZipFile,
                zlib.error) as error:
            return looks, (f"{path} is damaged ({shorten_error(error)}); the drive is looked at "
                           f"again from frame {first} on")
        first += PIECE
    return looks, ""


def _looks(file: Any) -> list[Look]:
    """Of a piece."""
    names, poses = [str(name) for name in file["names"]], file["poses"]
    parts = [np.split(file[name], np.cumsum(file[f"{name}_counts"])[:-1]) for name in PARTS]
    return [Look(Detections(boxes, classes, scores), clusters, images,
                 dict(zip(names, features.T)) if len(clusters) else {}, things,
                 poses[i] if len(poses) else None)
            for i, (boxes, classes, scores, clusters, images, features, things)
            in enumerate(zip(*parts, strict=True))]

