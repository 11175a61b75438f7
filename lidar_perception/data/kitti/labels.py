"""KITTI labels <-> GroundTruth in the LiDAR frame, without loss.

label_2 (object), label_02 (tracking) and tracklet_labels.xml (raw).
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from lidar_perception.classes import class_name
from lidar_perception.geometry import wrap_angle
from lidar_perception.runs.files import read_text, regular
from lidar_perception.types import CLASSES, LARGEST, GroundTruth, InputError, class_ids

# The label file's own names and numbers, in its order; they travel in GroundTruth.extras.
COLUMNS = ("truncated", "occluded", "alpha", "bbox", "dimensions", "location", "rotation_y")
OTHER_NAMES = {"Person": "Person_sitting"}  # the tracking benchmark's name
# A region that was not labelled: only its 2D box is known.
DONT_CARE = {"track_id": -1, "truncated": -1.0, "occluded": -1, "alpha": -10.0,
             "dimensions": [-1.0] * 3, "location": [-1000.0] * 3, "rotation_y": -10.0}


def read_object_labels(path: Path, lidar_to_camera: np.ndarray) -> GroundTruth:
    """The objects of one label_2 file; lidar_to_camera (4, 4)."""
    return to_ground_truth([label for _, label in parsed_lines(path)], lidar_to_camera)


def read_tracking_labels(path: Path, lidar_to_camera: np.ndarray,
                         known_only: bool = False) -> dict[int, GroundTruth]:
    """Frame number -> objects, of one label_02 file. Frames without objects are left out."""
    frames: dict[int, list[dict]] = {}
    for _, frame, label in parsed_tracking_lines(path, known_only):
        frames.setdefault(frame, []).append(label)
    return {k: to_ground_truth(v, lidar_to_camera) for k, v in frames.items()}


def parsed_lines(path: Path, known_only: bool = False) -> list[tuple[int, dict]]:
    """Line number, from 1, and parse() of every line of a label_2 or result file."""
    return [(i, parse(line, path, i, known_only)) for i, line in _lines(path)]


def parsed_tracking_lines(path: Path, known_only: bool = False) -> list[tuple[int, int, dict]]:
    """Line number, from 1, the frame's number, and parse() with track_id of every line of a
    label_02 file."""
    found = []
    for i, line in _lines(path):
        try:
            frame, track, rest = line.split(maxsplit=2)
            found.append((i, int(frame), dict(parse(rest, path, i, known_only),
                                              track_id=int(track))))
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}:{i} is no tracking label: {line!r}") from None
    return found


def parse(line: str, path: Path | str = "label", number: int = 0, known_only: bool = False) -> dict:
    """Return one label line as a dict: class, the COLUMNS, and score where the line has one.

    A class is the one in CLASSES that the line spells in any case, as KITTI's own program compares
    names, or else the text of the line. InputError for the latter with known_only.
    """
    words = line.split()
    first = next((i for i, word in enumerate(words[1:], 1) if _is_number(word)), 1)
    text = " ".join(words[:first])  # some tools leave blanks in the names of classes
    try:
        numbers = [float(w) for w in words[first:]]
        if len(numbers) not in (14, 15) or not all(abs(n) <= LARGEST for n in numbers):
            raise ValueError
    except ValueError:
        raise InputError(f"{path}:{number} is no KITTI label (a class and 14 or 15 numbers): "
                         f"{line[:200]!r}") from None
    name = OTHER_NAMES.get(text) or class_name(text)
    if name not in CLASSES and known_only:
        raise InputError(f"{path}:{number} has the unknown class {text!r}; known are "
                         f"{', '.join(CLASSES)}")
    label = {"class": name, "truncated": numbers[0], "occluded": int(numbers[1]),
             "alpha": numbers[2], "bbox": numbers[3:7], "dimensions": numbers[7:10],
             "location": numbers[10:13], "rotation_y": numbers[13]}
    if len(numbers) == 15:
        label["score"] = numbers[14]
    return label


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def to_ground_truth(labels: list[dict], lidar_to_camera: np.ndarray) -> GroundTruth:
    """Boxes in the LiDAR frame. Objects without a 3D box (DontCare) become notes; those of a class
    that is not in CLASSES are Misc, with its name as class_name."""
    to_lidar = np.linalg.inv(lidar_to_camera)
    boxes, names, extras, notes = [], [], [], []
    for label in labels:
        extra = {k: v for k, v in label.items() if k != "class"}
        box = lidar_box(label, to_lidar)
        if box is None:
            notes.append((label["class"], extra))
            continue
        boxes.append(box)
        names.append(label["class"])
        extras.append(extra if names[-1] in CLASSES else {**extra, "class_name": names[-1]})
    return GroundTruth.of(boxes, class_ids(names), extras, notes)


def lidar_box(label: dict, to_lidar: np.ndarray) -> list[float] | None:
    """[x y z l w h yaw] of a label, to_lidar (4, 4) from the camera; None without a 3D box."""
    h, w, length = label["dimensions"]
    if min(h, w, length) <= 0:
        return None
    x, y, z = label["location"]  # centre of the bottom face; y points down
    centre = to_lidar @ [x, y - h / 2, z, 1.0]
    heading = to_lidar[:3, :3] @ [np.cos(label["rotation_y"]), 0, -np.sin(label["rotation_y"])]
    return [*centre[:3].tolist(), length, w, h, float(np.arctan2(heading[1], heading[0]))]


def to_labels(truth: GroundTruth, lidar_to_camera: np.ndarray) -> list[dict]:
    """The inverse of to_ground_truth up to order (notes come last). What extras do not hold is
    computed from the box; the 2D box is then zero."""
    labels = []
    for box, name, extra in zip(truth.boxes, truth.labels, truth.extras):
        labels.append({"class": extra.get("class_name", name), **camera_box(box, lidar_to_camera),
                       **{key: value for key, value in extra.items() if key != "class_name"}})
    return labels + [{"class": name, **extra} for name, extra in truth.notes]


def camera_box(box: np.ndarray, lidar_to_camera: np.ndarray) -> dict:
    """dimensions, location, rotation_y and alpha of a LiDAR box (7,), the inverse of lidar_box;
    nothing truncated."""
    x, y, z, length, w, h, yaw = (float(v) for v in box)
    centre = lidar_to_camera @ [x, y, z, 1.0]
    # The turn about the camera's y axis, of which yaw is what the LiDAR sees: the two axes lean
    # against one another.
    right, ahead = lidar_to_camera[0, :2], lidar_to_camera[2, :2]
    rotation = float(np.arctan2(right[1] * np.cos(yaw) - right[0] * np.sin(yaw),
                                ahead[1] * np.cos(yaw) - ahead[0] * np.sin(yaw)))
    if (np.cos(rotation) * right - np.sin(rotation) * ahead) @ [np.cos(yaw), np.sin(yaw)] < 0:
        rotation = float(wrap_angle(rotation + np.pi))
    location = [float(centre[0]), float(centre[1] + h / 2), float(centre[2])]
    alpha = float(wrap_angle(rotation - np.arctan2(location[0], location[2])))
    return {"truncated": 0.0, "occluded": 0, "alpha": alpha, "bbox": [0.0] * 4,
            "dimensions": [h, w, length], "location": location, "rotation_y": rotation}


def format_label(label: dict, decimals: int = 2, whole: bool = True) -> str:
    """The label_2 line of a label. whole: the -1, -10 and -1000 of DontCare are whole numbers, as
    in the object layout."""
    numbers = [label["alpha"], *label["bbox"], *label["dimensions"], *label["location"],
               label["rotation_y"]] + ([label["score"]] if "score" in label else [])
    words = [label["class"], label["truncated"], str(label["occluded"]), *numbers]
    if label["class"] == "DontCare" and whole:
        return " ".join(f"{w:g}" if w in (-1, -10, -1000) else f"{w:.{decimals}f}"
                        if isinstance(w, float) else w for w in words)
    return " ".join(f"{w:.{decimals}f}" if isinstance(w, float) else w for w in words)


def read_tracklets(path: Path) -> dict[int, GroundTruth]:
    """Read a raw drive's tracklet_labels.xml, of KITTI or as CVAT and Datumaro export it.

    Returns: frame number -> objects in the LiDAR frame; of a class that is not in CLASSES Misc,
    with its name as class_name. An object whose size is not above 0 is a note.
    Raises: InputError for a file that is no such XML.
    """
    frames: dict[int, tuple[list, list]] = {}
    try:
        tracklets = _child(ElementTree.parse(regular(path)).getroot(), "tracklets")
        for track, item in enumerate(tracklets.iterfind("item")):
            text = _text(item, "objectType").strip()
            h, w, length = (float(_text(item, k)) for k in "hwl")
            first = int(item.findtext("first_frame") or 0)
            for i, pose in enumerate(_child(item, "poses").iterfind("item")):
                x, y, z, yaw = (float(_text(pose, k)) for k in ("tx", "ty", "tz", "rz"))
                occluded, truncated = (_state(pose, k) for k in ("occlusion", "truncation"))
                if truncated is None:
                    continue
                extra = {"track_id": track, "occluded": int(occluded or 0), "truncated": truncated}
                boxes, notes = frames.setdefault(first + i, ([], []))
                if min(h, w, length) <= 0:
                    notes.append((class_name(text), extra))
                else:
                    boxes.append(([x, y, z + h / 2, length, w, h, yaw], text, extra))
    except (OSError, ElementTree.ParseError, ValueError, OverflowError) as error:
        raise InputError(f"cannot read the tracklets {path}: {error}") from None
    return {number: _of_tracklets(*found) for number, found in frames.items()}


def _of_tracklets(rows: list, notes: list) -> GroundTruth:
    boxes, texts, extras = (list(column) for column in zip(*rows)) if rows else ([], [], [])
    extras = [extra if class_name(text) in CLASSES else {**extra, "class_name": text}
              for text, extra in zip(texts, extras)]
    return GroundTruth.of(boxes, class_ids(texts), extras, notes)


def _state(pose: ElementTree.Element, name: str) -> float | None:
    """The number of a pose's state, 0 where it has none; None where Datumaro only fills a gap
    between two boxes of a track: it writes the name of the state then.
    https://github.com/openvinotoolkit/datumaro/blob/develop/src/datumaro/plugins/data_formats/kitti_raw/exporter.py
    """
    text = (pose.findtext(name) or "0").strip()
    return None if text.startswith(("TruncationStates.", "OcclusionStates.")) else float(text)


def _child(element: ElementTree.Element, name: str) -> ElementTree.Element:
    found = element.find(name)
    if found is None:
        raise ValueError(f"<{element.tag}> has no <{name}>")
    return found


def _text(element: ElementTree.Element, name: str) -> str:
    return _child(element, name).text or ""


def _lines(path: Path) -> list[tuple[int, str]]:
    lines = read_text(path, what="the labels").splitlines()
    return [(i, line) for i, line in enumerate(lines, 1) if line.strip()]
