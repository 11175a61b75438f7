"""Lossless conversion between KITTI's labels and GroundTruth in the LiDAR frame.

KITTI has label files in the folders label_2 (object) and label_02 (tracking), and
tracklet_labels.xml (raw).
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from lidar_perception.classes import find_class_name
from lidar_perception.geometry import wrap_angle
from lidar_perception.runs.files import check_regular, read_text
from lidar_perception.types import CLASSES, MAX_NUMBER, GroundTruth, InputError, find_class_ids

# Columns of a label file after the class, in order, stored in GroundTruth.extras.
COLUMNS = ("truncated", "occluded", "alpha", "bbox", "dimensions", "location", "rotation_y")
NAME_BY_TRACKING_NAME = {"Person": "Person_sitting"}  # name in the tracking benchmark -> name in the object benchmark
# Columns of DontCare, an unlabelled region of which only the 2D box is known.
DONT_CARE = {
    "track_id": -1,
    "truncated": -1.0,
    "occluded": -1,
    "alpha": -10.0,
    "dimensions": [-1.0] * 3,
    "location": [-1000.0] * 3,
    "rotation_y": -10.0,
}


def read_object_labels(path: Path, lidar_to_camera: np.ndarray) -> GroundTruth:
    """Read the objects in a label_2 file, given the transform (4, 4) from LiDAR to camera."""
    return to_ground_truth([label for _, label in parse_lines(path)], lidar_to_camera)


def read_tracking_labels(path: Path, lidar_to_camera: np.ndarray) -> dict[int, GroundTruth]:
    """Read the objects in a label_02 file by frame number; frames without objects are left out."""
    frames: dict[int, list[dict]] = {}
    for _, frame, label in parse_tracking_lines(path):
        frames.setdefault(frame, []).append(label)
    return {k: to_ground_truth(v, lidar_to_camera) for k, v in frames.items()}


def parse_lines(path: Path, known_only: bool = False) -> list[tuple[int, dict]]:
    """Return (line number from 1, result of parse_label) for each line of a label_2 or result file."""
    return [(i, parse_label(line, path, i, known_only)) for i, line in _read_lines(path)]


def parse_tracking_lines(path: Path) -> list[tuple[int, int, dict]]:
    """Return (line number from 1, frame number, result of parse_label with track_id) for each line of a file."""
    labels = []
    for i, line in _read_lines(path):
        try:
            frame, track, rest = line.split(maxsplit=2)
            labels.append((i, int(frame), dict(parse_label(rest, path, i), track_id=int(track))))
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"{path}:{i} is not a tracking label: {line!r}") from None
    return labels


def parse_label(line: str, path: Path | str = "label", number: int = 0, known_only: bool = False) -> dict:
    """Parse a label line to a dict with the class, COLUMNS, and the score if the line has one.

    The class is matched to CLASSES, ignoring case as KITTI's program does; an unknown name is kept
    as written.

    Raises:
        InputError: the line is malformed, or known_only is set and the class is unknown.
    """
    words = line.split()
    first_number = next((i for i, word in enumerate(words[1:], 1) if _is_number(word)), 1)
    text = " ".join(words[:first_number])  # some tools write class names with spaces
    try:
        numbers = [float(w) for w in words[first_number:]]
        if len(numbers) not in (14, 15) or not all(abs(n) <= MAX_NUMBER for n in numbers):
            raise ValueError
    except ValueError:
        raise InputError(
            f"{path}:{number} is not a KITTI label (a class and 14 or 15 numbers): {line[:200]!r}"
        ) from None
    name = NAME_BY_TRACKING_NAME.get(text) or find_class_name(text)
    if name not in CLASSES and known_only:
        raise InputError(f"{path}:{number} has the unknown class {text!r}; known classes: {', '.join(CLASSES)}")
    label = {
        "class": name,
        "truncated": numbers[0],
        "occluded": int(numbers[1]),
        "alpha": numbers[2],
        "bbox": numbers[3:7],
        "dimensions": numbers[7:10],
        "location": numbers[10:13],
        "rotation_y": numbers[13],
    }
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
    """Convert labels to boxes in the LiDAR frame.

    Objects without a 3D box (DontCare) become notes. Unknown classes become Misc, with their name
    as class_name.
    """
    to_lidar = np.linalg.inv(lidar_to_camera)
    boxes, names, extras, notes = [], [], [], []
    for label in labels:
        extra = {k: v for k, v in label.items() if k != "class"}
        box = to_lidar_box(label, to_lidar)
        if box is None:
            notes.append((label["class"], extra))
            continue
        boxes.append(box)
        names.append(label["class"])
        extras.append(extra)
    return _make_ground_truth(boxes, names, extras, notes)


def _make_ground_truth(boxes: list, names: list[str], extras: list[dict], notes: list) -> GroundTruth:
    """Make GroundTruth; unknown classes become Misc, with their name as class_name."""
    extras = [extra if name in CLASSES else {**extra, "class_name": name} for name, extra in zip(names, extras)]
    return GroundTruth.of(boxes, find_class_ids(names), extras, notes)


def to_lidar_box(label: dict, to_lidar: np.ndarray) -> list[float] | None:
    """Return the box [x y z l w h yaw] of a label in the LiDAR frame; None if it has no 3D box.

    Args:
        label: result of parse_label.
        to_lidar: (4, 4) transform from camera to LiDAR.
    """
    h, w, length = label["dimensions"]
    if min(h, w, length) <= 0:
        return None
    x, y, z = label["location"]  # centre of the bottom face; y points down
    centre = to_lidar @ [x, y - h / 2, z, 1.0]
    heading = to_lidar[:3, :3] @ [np.cos(label["rotation_y"]), 0, -np.sin(label["rotation_y"])]
    return [*centre[:3].tolist(), length, w, h, float(np.arctan2(heading[1], heading[0]))]


def to_labels(truth: GroundTruth, lidar_to_camera: np.ndarray) -> list[dict]:
    """Convert GroundTruth to labels: the inverse of to_ground_truth, except that notes come last.

    Columns that are missing in extras are computed from the box; a missing 2D box is 0.
    """
    labels = []
    for box, name, extra in zip(truth.boxes, truth.labels, truth.extras):
        labels.append(
            {
                "class": extra.get("class_name", name),
                **to_camera_box(box, lidar_to_camera),
                **{key: value for key, value in extra.items() if key != "class_name"},
            }
        )
    return labels + [{"class": name, **extra} for name, extra in truth.notes]


def to_camera_box(box: np.ndarray, lidar_to_camera: np.ndarray) -> dict:
    """Return the columns of a box (7,) in the LiDAR frame, the inverse of to_lidar_box.

    Truncation, occlusion and the 2D box are 0.
    """
    x, y, z, length, w, h, yaw = (float(v) for v in box)
    centre = lidar_to_camera @ [x, y, z, 1.0]
    # Find the rotation about the camera's y axis that corresponds to this yaw in the LiDAR frame. The
    # vertical axes of camera and LiDAR are not parallel.
    right_axis, forward_axis = lidar_to_camera[0, :2], lidar_to_camera[2, :2]
    rotation = float(
        np.arctan2(
            right_axis[1] * np.cos(yaw) - right_axis[0] * np.sin(yaw),
            forward_axis[1] * np.cos(yaw) - forward_axis[0] * np.sin(yaw),
        )
    )
    if (np.cos(rotation) * right_axis - np.sin(rotation) * forward_axis) @ [np.cos(yaw), np.sin(yaw)] < 0:
        rotation = float(wrap_angle(rotation + np.pi))
    location = [float(centre[0]), float(centre[1] + h / 2), float(centre[2])]
    alpha = float(wrap_angle(rotation - np.arctan2(location[0], location[2])))
    return {
        "truncated": 0.0,
        "occluded": 0,
        "alpha": alpha,
        "bbox": [0.0] * 4,
        "dimensions": [h, w, length],
        "location": location,
        "rotation_y": rotation,
    }


def format_label(label: dict, decimals: int = 2, object_layout: bool = True) -> str:
    """Format a label as a line of a label_2 file.

    Args:
        decimals: number of decimals.
        object_layout: True to write the -1, -10 and -1000 of DontCare as integers, as in the object
            layout.
    """
    numbers = [label["alpha"], *label["bbox"], *label["dimensions"], *label["location"], label["rotation_y"]] + (
        [label["score"]] if "score" in label else []
    )
    words = [label["class"], label["truncated"], str(label["occluded"]), *numbers]
    if label["class"] == "DontCare" and object_layout:
        return " ".join(
            f"{w:g}" if w in (-1, -10, -1000) else f"{w:.{decimals}f}" if isinstance(w, float) else w for w in words
        )
    return " ".join(f"{w:.{decimals}f}" if isinstance(w, float) else w for w in words)


def read_tracklets(path: Path) -> dict[int, GroundTruth]:
    """Read a tracklet_labels.xml of KITTI's raw drives, or one exported by CVAT or Datumaro.

    Returns:
        The objects in the LiDAR frame by frame number. Unknown classes become Misc, with their name
        as class_name. Objects without a positive size become notes.

    Raises:
        InputError: the file cannot be read, or has another format.
    """
    frames: dict[int, tuple[list, list, list, list]] = {}  # number -> boxes, class names, extras, notes
    try:
        tracklets = _find_child(ElementTree.parse(check_regular(path)).getroot(), "tracklets")
        for track, item in enumerate(tracklets.iterfind("item")):
            name = find_class_name(_find_text(item, "objectType").strip())
            h, w, length = (float(_find_text(item, k)) for k in "hwl")
            first_frame = int(item.findtext("first_frame") or 0)
            for i, pose in enumerate(_find_child(item, "poses").iterfind("item")):
                x, y, z, yaw = (float(_find_text(pose, k)) for k in ("tx", "ty", "tz", "rz"))
                occluded, truncated = (_parse_state(pose, k) for k in ("occlusion", "truncation"))
                if truncated is None:
                    continue
                extra = {"track_id": track, "occluded": int(occluded or 0), "truncated": truncated}
                boxes, names, extras, notes = frames.setdefault(first_frame + i, ([], [], [], []))
                if min(h, w, length) <= 0:
                    notes.append((name, extra))
                    continue
                boxes.append([x, y, z + h / 2, length, w, h, yaw])
                names.append(name)
                extras.append(extra)
    except (OSError, ElementTree.ParseError, ValueError, OverflowError) as error:
        raise InputError(f"cannot read the tracklets {path}: {error}") from None
    return {number: _make_ground_truth(*content) for number, content in frames.items()}


def _parse_state(pose: ElementTree.Element, name: str) -> float | None:
    """Return the occlusion or truncation of a pose; 0 if it is missing.

    Returns None for the boxes with which Datumaro fills the gaps of a track; their states are names.
    https://github.com/openvinotoolkit/datumaro/blob/develop/src/datumaro/plugins/data_formats/kitti_raw/exporter.py
    """
    text = (pose.findtext(name) or "0").strip()
    return None if text.startswith(("TruncationStates.", "OcclusionStates.")) else float(text)


def _find_child(element: ElementTree.Element, name: str) -> ElementTree.Element:
    child = element.find(name)
    if child is None:
        raise ValueError(f"<{element.tag}> has no <{name}>")
    return child


def _find_text(element: ElementTree.Element, name: str) -> str:
    return _find_child(element, name).text or ""


def _read_lines(path: Path) -> list[tuple[int, str]]:
    lines = read_text(path, noun="the labels").splitlines()
    return [(i, line) for i, line in enumerate(lines, 1) if line.strip()]
