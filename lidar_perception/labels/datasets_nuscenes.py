"""Writer of tables and sweeps in nuScenes' layout, readable by nuscenes-devkit.

The tables are defined by Caesar et al., CVPR 2020, and docs/schema_nuscenes.md of nuscenes-devkit.
A scene is a drive, and each scan is a key frame. The only sensor is LIDAR_TOP, with x to the right
and y forward; there are no cameras, maps or radars.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

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
from lidar_perception.data.nuscenes.folder import FULL_REFLECTION, LIDAR_CHANNEL
from lidar_perception.data.nuscenes.results import format_boxes
from lidar_perception.geometry import points_in_boxes
from lidar_perception.labels.drive_labels import NO_TRACK, FrameLabels
from lidar_perception.labels.formats.nuscenes import (
    CLASS_BY_NUSCENES_NAME,
    RIDDEN_CLASSES,
    WRITTEN_NAME_BY_CLASS,
    find_original_rotation,
)
from lidar_perception.runs.files import write_bytes, write_text

VERSION = "v1.0-trainval"
# Rotation from the frame's axes to those of LIDAR_TOP: x right, y ahead.
TO_SENSOR = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
CATEGORY_BY_NAME = {name: next(c for c, n in CATEGORIES.items() if n == name) for name in NAMES}
TABLES = (
    "category",
    "attribute",
    "visibility",
    "instance",
    "sensor",
    "calibrated_sensor",
    "ego_pose",
    "log",
    "scene",
    "sample",
    "sample_data",
    "sample_annotation",
    "map",
)
MAP = "maps/none.png"  # path of an empty map, which nuscenes-devkit requires
EMPTY_MAP = bytes.fromhex(  # PNG image with one black pixel
    "89504e470d0a1a0a0000000d49484452000000010000000108000000003a7e9b5500"
    "00000a49444154789c636000000002000148afa4710000000049454e44ae426082"
)


def make_token(*parts: object) -> str:
    """Return a token of 32 hexadecimal digits that depends only on the arguments."""
    return hashlib.sha256("/".join(map(str, parts)).encode()).hexdigest()[:32]


class NuscenesTables:
    """Writer of the tables of a data set. Call add() for each frame, then write()."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        self.rows["sensor"] = [{"token": make_token(LIDAR_CHANNEL), "channel": LIDAR_CHANNEL, "modality": "lidar"}]
        self.rows["log"] = [
            {"token": make_token("log"), "logfile": "", "vehicle": "", "location": "", "date_captured": ""}
        ]
        self.rows["map"] = [
            {
                "token": make_token("map"),
                "log_tokens": [make_token("log")],
                "category": "semantic_prior",
                "filename": MAP,
            }
        ]
        self.rows["attribute"] = [{"token": make_token(a), "name": a, "description": ""} for a in ATTRIBUTES]
        self.categories: dict[str, str] = {}
        self.instances: dict[str, dict[str, Any]] = {}
        self.last_rows: dict[str, dict[str, Any]] = {}  # TABLE/CHAIN -> last row added, see _add_linked

    def add(self, frame: Frame, labels: FrameLabels, drive: int, cloud: np.ndarray) -> None:
        """Add a frame to the tables, and write its sweep.

        Args:
            frame: Frame of the recording.
            drive: Number of the drive.
            cloud: (N, 4) [x y z intensity].

        Raises:
            InputError: The sweep cannot be written, or the frame cannot be read.
        """
        scene = f"scene-{drive + 1:04}"
        sample = make_token(scene, len(self.rows["sample"]))
        file = f"samples/{LIDAR_CHANNEL}/{scene}__{LIDAR_CHANNEL}__{frame.stamp_ns // 1000}.pcd.bin"
        if (self.folder / file).exists():  # some drivers write two scans with the same stamp
            file = file.replace(".pcd.bin", f"-{len(self.rows['sample'])}.pcd.bin")
        self._write_sweep(self.folder / file, cloud)
        pose = frame.pose()
        pose = np.eye(4) if pose is None else pose
        ego = pose[:3, 3] - pose[:3, :3] @ [0, 0, frame.sensor_height]
        mount = make_token("mount", frame.sensor_height)
        if not any(row["token"] == mount for row in self.rows["calibrated_sensor"]):
            self._add(
                "calibrated_sensor",
                mount,
                sensor_token=make_token(LIDAR_CHANNEL),
                translation=[0.0, 0.0, frame.sensor_height],
                rotation=_to_quaternion(TO_SENSOR.T),
                camera_intrinsic=[],
            )
        timestamp = {"timestamp": frame.stamp_ns // 1000}
        self._add(
            "ego_pose",
            make_token(sample, "ego"),
            **timestamp,
            translation=ego.tolist(),
            rotation=_to_quaternion(pose[:3, :3]),
        )
        self._add_linked("sample", scene, sample, **timestamp, scene_token=make_token(scene))
        self._add_linked(
            "sample_data",
            scene,
            make_token(sample, "data"),
            **timestamp,
            sample_token=sample,
            ego_pose_token=make_token(sample, "ego"),
            calibrated_sensor_token=mount,
            fileformat="pcd",
            is_key_frame=True,
            height=0,
            width=0,
            filename=file,
        )
        if not self.rows["scene"] or self.rows["scene"][-1]["name"] != scene:
            self._add(
                "scene",
                make_token(scene),
                name=scene,
                log_token=make_token("log"),
                nbr_samples=0,
                first_sample_token=sample,
                last_sample_token=sample,
                description="",
            )
        self.rows["scene"][-1] |= {
            "last_sample_token": sample,
            "nbr_samples": self.rows["scene"][-1]["nbr_samples"] + 1,
        }
        self._add_boxes(scene, sample, labels, pose, cloud)

    def _write_sweep(self, path: Path, cloud: np.ndarray) -> None:
        sweep = np.zeros((len(cloud), 5), np.float32)  # x y z intensity ring
        sweep[:, 0], sweep[:, 1], sweep[:, 2] = -cloud[:, 1], cloud[:, 0], cloud[:, 2]
        sweep[:, 3] = cloud[:, 3] * np.float32(FULL_REFLECTION)
        write_bytes(path, sweep.tobytes())

    def _add_boxes(self, scene: str, sample: str, labels: FrameLabels, pose: np.ndarray, cloud: np.ndarray) -> None:
        point_counts = np.diff(points_in_boxes(cloud, labels.boxes)[1]) if len(labels) else ()
        placements = format_boxes(sample, *to_global_boxes(labels.boxes, pose))
        for k, placement in enumerate(placements):
            track, name, extra = labels.track_ids[k], labels.class_names[k], labels.extra[k]
            lidar, radar = int(point_counts[k]), 0
            if rotation := find_original_rotation(labels, k, pose):  # true if the box is unchanged
                placement["rotation"] = rotation
                lidar = extra.get("lidar_points", lidar)
                radar = extra.get("points", lidar) - lidar
            instance = make_token(scene, "track", track) if track != NO_TRACK else make_token(sample, k)
            written_name = WRITTEN_NAME_BY_CLASS.get(name, name)
            category = extra.get("category")
            if CATEGORIES.get(str(category), category) != written_name:
                category = CATEGORY_BY_NAME.get(written_name, name)
            attribute = extra.get("attribute") or (
                ATTRIBUTES[WITH_RIDER]
                if name in CLASS_BY_NUSCENES_NAME.values() and written_name in RIDDEN_CLASSES
                else None
            )
            if instance not in self.instances:
                self._add(
                    "instance",
                    instance,
                    category_token=self._get_category(str(category)),
                    nbr_annotations=0,
                    first_annotation_token=make_token(sample, instance),
                )
                self.instances[instance] = self.rows["instance"][-1]
            row = self.instances[instance]
            row |= {
                "nbr_annotations": row["nbr_annotations"] + 1,
                "last_annotation_token": make_token(sample, instance),
            }
            attributes = [make_token(attribute)] if attribute in ATTRIBUTES else []
            self._add_linked(
                "sample_annotation",
                instance,
                make_token(sample, instance),
                **placement,
                instance_token=instance,
                visibility_token="",
                attribute_tokens=attributes,
                num_lidar_pts=lidar,
                num_radar_pts=radar,
            )

    def _get_category(self, name: str) -> str:
        if name not in self.categories:
            self.categories[name] = make_token("category", name)
            self._add("category", self.categories[name], name=name, description="")
        return self.categories[name]

    def _add(self, table: str, token: str, /, **values: Any) -> None:
        self.rows[table].append({"token": token, **values})

    def _add_linked(self, table: str, chain: str, token: str, /, **values: Any) -> None:
        """Add a row, and link it with the previous row of its chain (scene or instance)."""
        previous = self.last_rows.get(f"{table}/{chain}")
        self._add(table, token, **values, prev=previous["token"] if previous else "", next="")
        if previous is not None:
            previous["next"] = token
        self.last_rows[f"{table}/{chain}"] = self.rows[table][-1]

    def write(self) -> None:
        """Write the tables. Raise InputError if a file cannot be written."""
        write_bytes(self.folder / MAP, EMPTY_MAP)
        for name, rows in self.rows.items():
            write_text(self.folder / VERSION / f"{name}.json", json.dumps(rows, indent=0))


def _to_quaternion(rotation: np.ndarray) -> list[float]:
    return to_quaternions(rotation[None])[0].tolist()
