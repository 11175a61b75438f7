"""Labels of nuScenes: the boxes of all key frames, stored as columns."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np

from lidar_perception.data.nuscenes.boxes import (
    ATTRIBUTES,
    CATEGORIES,
    NAMES,
    WITH_RIDER,
    GlobalBoxes,
    are_tilted,
    to_local_boxes,
)
from lidar_perception.data.nuscenes.tables import Tables
from lidar_perception.types import CLASSES, GroundTruth, InputError

LABEL_TABLE = "sample_annotation"
BLOCK_SIZE = 4096  # number of labels converted to columns at a time
BIKE_RACK = "static_object.bicycle_rack"
MAX_TIME_S = 1.5  # maximum time between adjacent labels from which a velocity is computed
# nuScenes class -> class in types.CLASSES; a bicycle with a rider is a Cyclist, others are Misc.
CLASS_BY_NAME = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian"}


@dataclass(frozen=True)
class NuscenesLabels:
    """K labels in the global frame.

    Attributes:
        boxes: K boxes, with the total number of LiDAR and radar points in each.
        categories: (K,) int indices into category_names.
        lidar_points: (K,) int, number of LiDAR points in the box.
        instances: (K,) int object ids, constant over the frames.
    """

    boxes: GlobalBoxes
    categories: np.ndarray
    category_names: tuple[str, ...]
    lidar_points: np.ndarray
    instances: np.ndarray

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, index) -> NuscenesLabels:
        """Return the labels selected by a mask, slice or index array."""
        return NuscenesLabels(
            self.boxes[index],
            self.categories[index],
            self.category_names,
            self.lidar_points[index],
            self.instances[index],
        )

    def select_bicycle_racks(self) -> GlobalBoxes:
        """Return the boxes of bicycle racks."""
        is_rack = np.array([name == BIKE_RACK for name in self.category_names], bool)
        return self.boxes[is_rack[self.categories]]

    def to_ground_truth(self, pose: np.ndarray) -> GroundTruth:
        """Convert the labels of one frame to the coordinates of the frame.

        The extras are detection_name (None if the category has no class in the detection task),
        category, lidar_points, points (LiDAR and radar), velocity (2,) m/s in the global frame,
        attribute, track_id, and for a tilted box rotation (4,) [w x y z] in the global frame.

        Args:
            pose: (4, 4) pose of the frame in the global frame.
        """
        boxes, extras, ids = self.boxes, [], []
        is_tilted = are_tilted(boxes, pose)
        for i in range(len(self)):
            name = NAMES[boxes.class_ids[i]] if boxes.class_ids[i] >= 0 else None
            attribute = boxes.attributes[i]
            has_rider = name == "bicycle" and attribute == WITH_RIDER
            ids.append(CLASSES.index("Cyclist" if has_rider else CLASS_BY_NAME.get(name or "", "Misc")))
            extras.append(
                {
                    "detection_name": name,
                    "category": self.category_names[self.categories[i]],
                    "lidar_points": int(self.lidar_points[i]),
                    "points": int(boxes.points[i]),
                    "velocity": boxes.velocities[i].tolist(),
                    "track_id": int(self.instances[i]),
                    "attribute": ATTRIBUTES[attribute] if attribute >= 0 else None,
                    **({"rotation": boxes.rotations[i].tolist()} if is_tilted[i] else {}),
                }
            )
        return GroundTruth.of(to_local_boxes(boxes, pose), ids, extras)


def read_labels(tables: Tables, times: dict[str, int]) -> list[NuscenesLabels] | None:
    """Read the labels of key frames.

    All frames of a scene must be given, because velocities are computed from adjacent frames.

    Args:
        tables: tables of the data set.
        times: time in us of each key frame, by its sample token.

    Returns:
        The labels of each key frame, in the given order; None if the version has no labels, such as
        the test split.

    Raises:
        InputError: a table is invalid.
    """
    if tables.version.endswith("test") and not tables.get_path(LABEL_TABLE).exists():
        return None
    frame_by_token = {token: number for number, token in enumerate(times)}
    names = dict(tables.read_rows("category", "token", "name"))
    category_by_token = {token: number for number, token in enumerate(names)}
    attributes = {
        token: ATTRIBUTES.index(name) if name in ATTRIBUTES else -1
        for token, name in tables.read_rows("attribute", "token", "name")
    }
    instances = {
        token: (number, category_by_token.get(category, -1))
        for number, (token, category) in enumerate(tables.read_rows("instance", "token", "category_token"))
    }
    label_numbers, links, frame_numbers, object_numbers, category_numbers = (array("q") for _ in range(5))
    tokens: dict[str, int] = {}  # token -> number of the label, in order of first occurrence
    fields = ("translation", "size", "rotation")
    block, blocks = [], []
    for token, sample, instance, previous_token, next_token, lidar, radar, labels, *box in tables.read_rows(
        LABEL_TABLE,
        "token",
        "sample_token",
        "instance_token",
        "prev",
        "next",
        "num_lidar_pts",
        "num_radar_pts",
        "attribute_tokens",
        *fields,
    ):
        if sample not in frame_by_token:
            continue
        number, category = instances.get(instance, (-1, -1))
        if category < 0:
            raise InputError(
                f"{tables.get_path(LABEL_TABLE)}: the instance {instance} of label {token} is not in "
                "the instance table, or has no category; download the tables again"
            )
        label_numbers.append(tokens.setdefault(token, len(tokens)))
        links.extend([tokens.setdefault(other, len(tokens)) if other else -1 for other in (previous_token, next_token)])
        frame_numbers.append(frame_by_token[sample])
        object_numbers.append(number)
        category_numbers.append(category)
        block.append((*box, (lidar, radar, attributes.get(str(labels[0]), -1) if labels else -1)))
        if len(block) == BLOCK_SIZE:
            blocks.append(_to_columns(tables, block))
            block.clear()
    if not label_numbers:
        return None
    numbers = np.concatenate([*blocks, _to_columns(tables, block)])
    centres, sizes, rotations, counts = np.split(numbers, (3, 6, 10), axis=1)
    frames, neighbours = np.array(frame_numbers), _link_neighbours(tables, tokens, label_numbers, links)
    seconds = np.fromiter(times.values(), np.int64, len(times))[frames] * 1e-6
    categories, classes = np.array(category_numbers), [CATEGORIES.get(name) for name in names.values()]
    class_ids = np.array([NAMES.index(name) if name else -1 for name in classes])[categories]
    boxes = GlobalBoxes.of(
        centres,
        sizes[:, [1, 0, 2]],
        rotations,
        class_ids,
        counts[:, 2],
        _compute_velocities(centres, seconds, neighbours),
        points=counts[:, 0] + counts[:, 1],
    )
    all_labels = NuscenesLabels(
        boxes, categories, tuple(names.values()), counts[:, 0].astype(np.int32), np.array(object_numbers)
    )
    order = np.argsort(frames, kind="stable")
    bounds = np.searchsorted(frames[order], np.arange(1, len(times)))
    return [all_labels[rows] for rows in np.split(order, bounds)]


def _link_neighbours(tables: Tables, tokens: dict[str, int], numbers: array, links: array) -> np.ndarray:
    """Return the rows (K, 2) of the previous and next label of the same object, -1 = none.

    Args:
        tokens: number of each label, by its token.
        numbers: (K,) number of the label in each row.
        links: (2 K,) numbers of the previous and next labels, -1 = none.
    """
    link_pairs = np.array(links).reshape(-1, 2)
    row_by_number = np.full(len(tokens) + 1, -1)  # the last element is for the link -1 (no label)
    row_by_number[numbers] = np.arange(len(numbers))
    neighbours = row_by_number[link_pairs]
    if (is_missing := (neighbours < 0) & (link_pairs >= 0)).any():
        token = next(token for token, number in tokens.items() if number == link_pairs[is_missing][0])
        raise InputError(
            f"{tables.get_path(LABEL_TABLE)}: another label links to label {token}, which is missing; download it again"
        )
    return neighbours


def _to_columns(tables: Tables, block: list[tuple]) -> np.ndarray:
    """Convert B labels to columns (B, 13) float64.

    The columns are centre, size w l h, quaternion, number of LiDAR points, number of radar points,
    and attribute.
    """
    fields = (("translation", 3), ("size", 3), ("rotation", 4), ("count of points", 3))
    return np.hstack(
        [
            tables.convert_numbers(LABEL_TABLE, name, [row[i] for row in block], width)
            for i, (name, width) in enumerate(fields)
        ]
    )


def _compute_velocities(centres: np.ndarray, seconds: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Compute velocities (K, 2) m/s from the previous and the next label of the same object.

    If one of them is missing, the label itself is used instead. The velocity is NaN if both are
    missing or if the labels are too far apart in time.
    """
    indices = np.arange(len(centres))
    first, last = (np.where(rows >= 0, rows, indices) for rows in neighbours.T)
    time = seconds[last] - seconds[first]
    max_time = np.where((neighbours >= 0).all(axis=1), 2 * MAX_TIME_S, MAX_TIME_S)
    is_valid = (time > 0) & (time <= max_time)
    distance = (centres[last] - centres[first])[:, :2]
    return np.divide(distance, time[:, None], out=np.full_like(distance, np.nan), where=is_valid[:, None])
