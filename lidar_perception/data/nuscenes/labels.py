"""The labels of nuScenes: every box of every key frame, as columns."""

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
    in_frame,
    leaning,
)
from lidar_perception.data.nuscenes.tables import Tables
from lidar_perception.types import CLASSES, GroundTruth, InputError

TABLE = "sample_annotation"
BLOCK = 4096        # labels whose numbers are made columns at a time
BIKE_RACK = "static_object.bicycle_rack"
MAX_TIME = 1.5     # seconds between two labels from which a velocity is taken; twice it from three
# Of types.CLASSES. A bicycle with a rider is a Cyclist, what is named nowhere here is Misc.
CLASS_OF = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian"}


@dataclass(frozen=True)
class NuscenesLabels:
    """K labels, in the global frame: boxes, whose points are those of LiDAR and radar;
    categories (K,) int into category_names; lidar_points (K,) int; instances (K,) int, the same
    number for the same object in all frames."""

    boxes: GlobalBoxes
    categories: np.ndarray
    category_names: tuple[str, ...]
    lidar_points: np.ndarray
    instances: np.ndarray

    def __len__(self) -> int:
        return len(self.boxes)

    def __getitem__(self, index) -> NuscenesLabels:
        """The labels under a mask, slice or index array."""
        return NuscenesLabels(self.boxes[index], self.categories[index], self.category_names,
                              self.lidar_points[index], self.instances[index])

    def racks(self) -> GlobalBoxes:
        """The bicycle racks."""
        names = np.array([name == BIKE_RACK for name in self.category_names], bool)
        return self.boxes[names[self.categories]]

    def in_frame(self, pose: np.ndarray) -> GroundTruth:
        """The labels of one frame in its own coordinates; pose (4, 4) leads to the global frame.
        extras: detection_name (None where the category is of no class of the task), category,
        lidar_points, points (LiDAR and radar), velocity (2,) m/s in the global frame, attribute,
        track_id; rotation (4,) [w x y z] in the global frame of a box that is set upright."""
        boxes, extras, ids = self.boxes, [], []
        leans = leaning(boxes, pose)
        for i in range(len(self)):
            name = NAMES[boxes.class_ids[i]] if boxes.class_ids[i] >= 0 else None
            attribute = boxes.attributes[i]
            rides = name == "bicycle" and attribute == WITH_RIDER
            ids.append(CLASSES.index("Cyclist" if rides else CLASS_OF.get(name or "", "Misc")))
            extras.append({
                "detection_name": name, "category": self.category_names[self.categories[i]],
                "lidar_points": int(self.lidar_points[i]), "points": int(boxes.points[i]),
                "velocity": boxes.velocities[i].tolist(), "track_id": int(self.instances[i]),
                "attribute": ATTRIBUTES[attribute] if attribute >= 0 else None,
                **({"rotation": boxes.rotations[i].tolist()} if leans[i] else {})})
        return GroundTruth.of(in_frame(boxes, pose), ids, extras)


def read_labels(tables: Tables, times: dict[str, int]) -> list[NuscenesLabels] | None:
    """The labels of each key frame of times {sample's token: its microseconds}, in their order;
    None where the version has none, as the test split. All frames of a scene must be there, as
    velocities come from the frames before and after. InputError names a table that is wrong."""
    if tables.version.endswith("test") and not tables.path(TABLE).exists():
        return None
    frame_of = {token: number for number, token in enumerate(times)}
    names = dict(tables.rows("category", "token", "name"))
    number_of = {token: number for number, token in enumerate(names)}
    attributes = {token: ATTRIBUTES.index(name) if name in ATTRIBUTES else -1
                  for token, name in tables.rows("attribute", "token", "name")}
    instances = {token: (number, number_of.get(category, -1)) for number, (token, category)
                 in enumerate(tables.rows("instance", "token", "category_token"))}
    own, links, in_frames, of_objects, of_categories = (array("q") for _ in range(5))
    tokens: dict[str, int] = {}  # a number for each label, in the order in which they are named
    fields = ("translation", "size", "rotation")
    block, blocks = [], []
    for (token, sample, instance, before, after, lidar, radar, labels, *box) in tables.rows(
            TABLE, "token", "sample_token", "instance_token", "prev", "next", "num_lidar_pts",
            "num_radar_pts", "attribute_tokens", *fields):
        if sample not in frame_of:
            continue
        number, category = instances.get(instance, (-1, -1))
        if category < 0:
            raise InputError(f"{tables.path(TABLE)}: the instance {instance} of {token} is in no "
                             "table, or has no category; download the tables again")
        own.append(tokens.setdefault(token, len(tokens)))
        links.extend([tokens.setdefault(other, len(tokens)) if other else -1
                      for other in (before, after)])
        in_frames.append(frame_of[sample])
        of_objects.append(number)
        of_categories.append(category)
        block.append((*box, (lidar, radar, attributes.get(str(labels[0]), -1) if labels else -1)))
        if len(block) == BLOCK:
            blocks.append(_columns(tables, block))
            block.clear()
    if not own:
        return None
    numbers = np.concatenate([*blocks, _columns(tables, block)])
    centres, sizes, rotations, counts = np.split(numbers, (3, 6, 10), axis=1)
    frames, neighbours = np.array(in_frames), _neighbours(tables, tokens, own, links)
    seconds = np.fromiter(times.values(), np.int64, len(times))[frames] * 1e-6
    categories, classes = np.array(of_categories), [CATEGORIES.get(name) for name in names.values()]
    class_ids = np.array([NAMES.index(name) if name else -1 for name in classes])[categories]
    boxes = GlobalBoxes.of(centres, sizes[:, [1, 0, 2]], rotations, class_ids, counts[:, 2],
                           _velocities(centres, seconds, neighbours),
                           points=counts[:, 0] + counts[:, 1])
    everything = NuscenesLabels(boxes, categories, tuple(names.values()),
                                counts[:, 0].astype(np.int32), np.array(of_objects))
    order = np.argsort(frames, kind="stable")
    bounds = np.searchsorted(frames[order], np.arange(1, len(times)))
    return [everything[rows] for rows in np.split(order, bounds)]


def _neighbours(tables: Tables, tokens: dict[str, int], own: array, links: array) -> np.ndarray:
    """(K, 2) rows of the labels of the same object before and after, -1 = none, from the numbers
    of the labels themselves (K,) and of those that they name (2 K,)."""
    named = np.array(links).reshape(-1, 2)
    row_of = np.full(len(tokens) + 1, -1)  # the last one is of link -1, to none
    row_of[own] = np.arange(len(own))
    neighbours = row_of[named]
    if (wrong := (neighbours < 0) & (named >= 0)).any():
        token = next(token for token, number in tokens.items() if number == named[wrong][0])
        raise InputError(f"{tables.path(TABLE)}: the label {token} is named before or after "
                         "another, but is not there; download it again")
    return neighbours


def _columns(tables: Tables, block: list[tuple]) -> np.ndarray:
    """(B, 13) float64: centre, size w l h, quaternion, points of LiDAR and of radar, attribute."""
    fields = (("translation", 3), ("size", 3), ("rotation", 4), ("count of points", 3))
    return np.hstack([tables.numbers(TABLE, name, [row[i] for row in block], width)
                      for i, (name, width) in enumerate(fields)])


def _velocities(centres: np.ndarray, seconds: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """(K, 2) m/s from the label before to that after, or from or to the label itself where there is
    only one of them; NaN where there is none, or too much time between."""
    own = np.arange(len(centres))
    first, last = (np.where(rows >= 0, rows, own) for rows in neighbours.T)
    time = seconds[last] - seconds[first]
    most = np.where((neighbours >= 0).all(axis=1), 2 * MAX_TIME, MAX_TIME)
    known = (time > 0) & (time <= most)
    way = (centres[last] - centres[first])[:, :2]
    return np.divide(way, time[:, None], out=np.full_like(way, np.nan), where=known[:, None])
