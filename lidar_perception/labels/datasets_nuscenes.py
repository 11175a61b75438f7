"""The tables and sweeps of a nuScenes folder; data/nuscenes/folder.py reads them back, and so does
nuscenes-devkit.

Caesar et al., CVPR 2020, and nuscenes-devkit's docs/schema_nuscenes.md define the tables. A scene
is a drive, and every scan a key frame. There is one sensor, LIDAR_TOP, with x to the right and y
ahead as theirs; no camera, no map, no radar.
"""

from __future__ import annotations

import hashlib
import json
import struct
from pathlib import Path
from typing import Any
from zlib import compress, crc32

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.boxes import (
    ATTRIBUTES,
    CATEGORIES,
    NAMES,
    WITH_RIDER,
    to_global_boxes,
    to_quaternions,
)
from lidar_perception.data.nuscenes.folder import CHANNEL, FULL_REFLECTION
from lidar_perception.data.nuscenes.results import format_boxes
from lidar_perception.geometry import points_in_boxes
from lidar_perception.labels.drive_labels import NO_TRACK, FrameLabels
from lidar_perception.labels.formats.nuscenes import OURS, RIDDEN, WRITTEN, rotation_read
from lidar_perception.runs.files import write_bytes, write_text

VERSION = "v1.0-trainval"
# From the frame's axes to those of their sensor: x right, y ahead.
TO_SENSOR = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
CATEGORY_OF = {name: next(c for c, n in CATEGORIES.items() if n == name) for name in NAMES}
TABLES = ("category", "attribute", "visibility", "instance", "sensor", "calibrated_sensor",
          "ego_pose", "log", "scene", "sample", "sample_data", "sample_annotation", "map")
MAP = "maps/none.png"  # nuscenes-devkit opens nothing without one


def token(*of: object) -> str:
    """32 hexadecimal digits, as theirs, the same for the same words."""
    return hashlib.sha256("/".join(map(str, of)).encode()).hexdigest()[:32]


class NuscenesTables:
    """Grows frame by frame; write() makes the tables."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        self.rows["sensor"] = [{"token": token(CHANNEL), "channel": CHANNEL, "modality": "lidar"}]
        self.rows["log"] = [{"token": token("log"), "logfile": "", "vehicle": "", "location": "",
                             "date_captured": ""}]
        self.rows["map"] = [{"token": token("map"), "log_tokens": [token("log")],
                             "category": "semantic_prior", "filename": MAP}]
        self.rows["attribute"] = [{"token": token(a), "name": a, "description": ""}
                                  for a in ATTRIBUTES]
        self.categories: dict[str, str] = {}
        self.instances: dict[str, dict[str, Any]] = {}
        self.last: dict[str, dict[str, Any]] = {}  # by table and what its rows are of

    def add(self, frame: Frame, labels: FrameLabels, drive: int, cloud: np.ndarray) -> None:
        """One scan (N, 4) [x y z intensity] with its labels. InputError where it cannot be
        written."""
        scene = f"scene-{drive + 1:04}"
        sample = token(scene, len(self.rows["sample"]))
        file = f"samples/{CHANNEL}/{scene}__{CHANNEL}__{frame.stamp_ns // 1000}.pcd.bin"
        if (self.folder / file).exists():  # of a driver that gives two scans one stamp
            file = file.replace(".pcd.bin", f"-{len(self.rows['sample'])}.pcd.bin")
        self._sweep(self.folder / file, cloud)
        pose = frame.pose()
        pose = np.eye(4) if pose is None else pose
        ego = pose[:3, 3] - pose[:3, :3] @ [0, 0, frame.sensor_height]
        mount = token("mount", frame.sensor_height)
        if not any(row["token"] == mount for row in self.rows["calibrated_sensor"]):
            self._add("calibrated_sensor", mount, sensor_token=token(CHANNEL),
                      translation=[0.0, 0.0, frame.sensor_height],
                      rotation=_quaternion(TO_SENSOR.T), camera_intrinsic=[])
        moment = {"timestamp": frame.stamp_ns // 1000}
        self._add("ego_pose", token(sample, "ego"), **moment, translation=ego.tolist(),
                  rotation=_quaternion(pose[:3, :3]))
        self._chain("sample", scene, sample, **moment, scene_token=token(scene))
        self._chain("sample_data", scene, token(sample, "data"), **moment, sample_token=sample,
                    ego_pose_token=token(sample, "ego"), calibrated_sensor_token=mount,
                    fileformat="pcd", is_key_frame=True, height=0, width=0, filename=file)
        if not self.rows["scene"] or self.rows["scene"][-1]["name"] != scene:
            self._add("scene", token(scene), name=scene, log_token=token("log"), nbr_samples=0,
                      first_sample_token=sample, last_sample_token=sample, description="")
        self.rows["scene"][-1] |= {"last_sample_token": sample,
                                   "nbr_samples": self.rows["scene"][-1]["nbr_samples"] + 1}
        self._boxes(scene, sample, labels, pose, cloud)

    def _sweep(self, path: Path, cloud: np.ndarray) -> None:
        sweep = np.zeros((len(cloud), 5), np.float32)  # x y z intensity ring
        sweep[:, 0], sweep[:, 1], sweep[:, 2] = -cloud[:, 1], cloud[:, 0], cloud[:, 2]
        sweep[:, 3] = cloud[:, 3] * np.float32(FULL_REFLECTION)
        write_bytes(path, sweep.tobytes())

    def _boxes(self, scene: str, sample: str, labels: FrameLabels, pose: np.ndarray,
               cloud: np.ndarray) -> None:
        inside = np.diff(points_in_boxes(cloud, labels.boxes)[1]) if len(labels) else ()
        placed = format_boxes(sample, *to_global_boxes(labels.boxes, pose))
        for k, place in enumerate(placed):
            track, name, extra = labels.track_ids[k], labels.class_names[k], labels.extra[k]
            lidar, radar = int(inside[k]), 0
            if rotation := rotation_read(labels, k, pose):  # as it was, and so are its points
                place["rotation"] = rotation
                lidar = extra.get("lidar_points", lidar)
                radar = extra.get("points", lidar) - lidar
            instance = token(scene, "track", track) if track != NO_TRACK else token(sample, k)
            kind = WRITTEN.get(name, name)
            category = extra.get("category")
            if CATEGORIES.get(str(category), category) != kind:
                category = CATEGORY_OF.get(kind, name)
            said = extra.get("attribute") or (
                ATTRIBUTES[WITH_RIDER] if name in OURS.values() and kind in RIDDEN else None)
            if instance not in self.instances:
                self._add("instance", instance, category_token=self._category(str(category)),
                          nbr_annotations=0, first_annotation_token=token(sample, instance))
                self.instances[instance] = self.rows["instance"][-1]
            row = self.instances[instance]
            row |= {"nbr_annotations": row["nbr_annotations"] + 1,
                    "last_annotation_token": token(sample, instance)}
            self._chain("sample_annotation", instance, token(sample, instance), **place,
                        instance_token=instance, visibility_token="",
                        attribute_tokens=[token(said)] if said in ATTRIBUTES else [],
                        num_lidar_pts=lidar, num_radar_pts=radar)

    def _category(self, name: str) -> str:
        if name not in self.categories:
            self.categories[name] = token("category", name)
            self._add("category", self.categories[name], name=name, description="")
        return self.categories[name]

    def _add(self, table: str, own: str, /, **values: Any) -> None:
        self.rows[table].append({"token": own, **values})

    def _chain(self, table: str, of: str, own: str, /, **values: Any) -> None:
        """A row that says which one comes before and after it."""
        before = self.last.get(f"{table}/{of}")
        self._add(table, own, **values, prev=before["token"] if before else "", next="")
        if before is not None:
            before["next"] = own
        self.last[f"{table}/{of}"] = self.rows[table][-1]

    def write(self) -> None:
        """The tables. InputError where they cannot be written."""
        write_bytes(self.folder / MAP, _png())
        for name, rows in self.rows.items():
            write_text(self.folder / VERSION / f"{name}.json", json.dumps(rows, indent=0))


def _quaternion(turn: np.ndarray) -> list[float]:
    return to_quaternions(turn[None])[0].tolist()


def _png() -> bytes:
    """One black pixel."""
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", crc32(kind + data))

    return (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0))
            + chunk(b"IDAT", compress(b"\0\0")) + chunk(b"IEND", b""))
