"""A synthetic nuScenes folder: tables as plain rows, sweeps with points in the boxes, and results.

It shares no code with the package.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

VERSION = "v1.0-mini"
SCENES = ("scene-0103", "scene-0916")  # the mini split's validation scenes
SIZES = {  # w l h
    "vehicle.car": (1.9, 4.6, 1.7),
    "vehicle.truck": (2.5, 7, 2.9),
    "vehicle.bus.rigid": (2.9, 11, 3.4),
    "vehicle.bus.bendy": (2.9, 14, 3.4),
    "vehicle.trailer": (2.9, 12, 3.8),
    "vehicle.construction": (2.8, 6.4, 3.2),
    "human.pedestrian.adult": (0.7, 0.7, 1.8),
    "human.pedestrian.child": (0.5, 0.5, 1.3),
    "vehicle.motorcycle": (0.8, 2.1, 1.5),
    "vehicle.bicycle": (0.6, 1.7, 1.3),
    "movable_object.trafficcone": (0.4, 0.4, 1.1),
    "movable_object.barrier": (2.5, 0.5, 1),
    "static_object.bicycle_rack": (3, 8, 1.4),
    "animal": (0.4, 0.9, 0.6),
}
ATTRIBUTES = {
    "human": ("pedestrian.moving", "pedestrian.sitting_lying_down", "pedestrian.standing"),
    "cycle": ("cycle.with_rider", "cycle.without_rider"),
    "vehicle": ("vehicle.moving", "vehicle.parked", "vehicle.stopped"),
}
SENSOR = (0.94, 0.02, 1.84)
POINTS_IN_BOX = 12


def list_attributes(category):
    if category in ("vehicle.motorcycle", "vehicle.bicycle"):
        return ATTRIBUTES["cycle"]
    return ATTRIBUTES.get(category.split(".")[0], ())


def to_wxyz(rotation):
    return np.roll(rotation.as_quat(), 1).tolist()


def to_rotation(row):
    return Rotation.from_quat(np.roll(row["rotation"], -1))


def make_tables(seed=0, frames=5, objects=40, scenes=SCENES):
    """Return {table: rows} of scenes with the given number of frames and objects."""
    rng = np.random.default_rng(seed)
    kinds = [name for names in ATTRIBUTES.values() for name in names]
    tables = {
        "category": [{"token": f"c{i}", "name": n} for i, n in enumerate(SIZES)],
        "attribute": [{"token": f"a{i}", "name": n} for i, n in enumerate(kinds)],
        "sensor": [
            {"token": "cam", "channel": "CAM_FRONT", "modality": "camera"},
            {"token": "top", "channel": "LIDAR_TOP", "modality": "lidar"},
        ],
        "calibrated_sensor": [],
        "scene": [],
        "sample": [],
        "sample_data": [],
        "ego_pose": [],
        "instance": [],
        "sample_annotation": [],
        "log": [],
        "visibility": [],
        "map": [{"token": "map", "log_tokens": [], "filename": f"{VERSION}/map.json"}],
    }
    for number, name in enumerate(scenes):
        make_scene(tables, rng, number, name, frames, objects, kinds)
    return tables


def make_scene(tables, rng, number, name, frames, objects, kinds):
    scene, tilt = f"s{number}", lambda: rng.uniform(-0.005, 0.005)
    tables["scene"].append(
        {
            "token": scene,
            "name": name,
            "nbr_samples": frames,
            "log_token": "",
            "description": "",
            "first_sample_token": f"{scene}k0",
            "last_sample_token": f"{scene}k{frames - 1}",
        }
    )
    for sensor, yaw in ("top", -math.pi / 2), ("cam", 0.3):
        tables["calibrated_sensor"].append(
            {
                "token": f"{scene}{sensor}",
                "sensor_token": sensor,
                "translation": list(SENSOR),
                "rotation": to_wxyz(Rotation.from_euler("zyx", [yaw + tilt(), 3 * tilt(), 3 * tilt()])),
                "camera_intrinsic": [],
            }
        )
    position, heading = rng.uniform(500, 1500, 2), rng.uniform(-3, 3)
    step = 4.0 * np.array([math.cos(heading), math.sin(heading)])
    start, duration = 1_532_402_927_000_000 + number * 10**8, 500_000
    for k in range(frames):
        sample, time = f"{scene}k{k}", start + k * duration + int(rng.integers(0, 20_000))
        if k == frames - 1:
            time += 2_000_000  # a gap over which velocities are unknown
        tables["sample"].append(
            {
                "token": sample,
                "timestamp": time,
                "scene_token": scene,
                "prev": f"{scene}k{k - 1}" if k else "",
                "next": f"{scene}k{k + 1}" if k < frames - 1 else "",
            }
        )
        for sensor, key in ("top", True), ("top", False), ("cam", True):
            token = f"{sample}{sensor}{key}"
            tables["ego_pose"].append(
                {
                    "token": token,
                    "timestamp": time,
                    "translation": [*(position + k * step), 0.0],
                    "rotation": to_wxyz(Rotation.from_euler("zyx", [heading + tilt(), tilt(), tilt()])),
                }
            )
            tables["sample_data"].append(
                {
                    "token": token,
                    "sample_token": sample,
                    "ego_pose_token": token,
                    "calibrated_sensor_token": f"{scene}{sensor}",
                    "timestamp": time + 7,
                    "fileformat": "pcd",
                    "is_key_frame": key,
                    "height": 0,
                    "width": 0,
                    "prev": "",
                    "next": "",
                    "filename": f"{'samples' if key else 'sweeps'}/"
                    f"{'LIDAR_TOP' if sensor == 'top' else 'CAM_FRONT'}/{token}.pcd.bin",
                }
            )
    for i in range(objects):
        make_object(tables, rng, scene, i, position, frames, kinds)


def make_object(tables, rng, scene, i, scene_position, frames, kinds):
    categories = list(SIZES)
    category, instance = categories[i % len(categories)], f"{scene}o{i}"
    first = int(rng.integers(0, frames - 1)) if rng.random() < 0.5 else 0
    last = int(rng.integers(first, frames))
    position, yaw = scene_position + rng.uniform(-42, 42, 2), rng.uniform(-math.pi, math.pi)
    speed = rng.uniform(0, 6) if category.startswith(("vehicle", "human")) else 0.0
    size = (np.array(SIZES[category]) * rng.uniform(0.9, 1.1, 3)).tolist()
    tables["instance"].append(
        {
            "token": instance,
            "category_token": f"c{categories.index(category)}",
            "nbr_annotations": last - first + 1,
            "first_annotation_token": f"{instance}k{first}",
            "last_annotation_token": f"{instance}k{last}",
        }
    )
    for k in range(first, last + 1):
        at = position + speed * (k - first) * 0.5 * np.array([math.cos(yaw), math.sin(yaw)])
        choice = [a for a in list_attributes(category) if rng.random() < 0.5][:1]
        lidar, radar = (0 if rng.random() < 0.1 else POINTS_IN_BOX), int(rng.random() < 0.1)
        tables["sample_annotation"].append(
            {
                "token": f"{instance}k{k}",
                "sample_token": f"{scene}k{k}",
                "instance_token": instance,
                "visibility_token": "",
                "attribute_tokens": [f"a{kinds.index(a)}" for a in choice],
                "translation": [*at.tolist(), size[2] / 2],
                "size": size,
                "rotation": to_wxyz(Rotation.from_euler("z", yaw + 0.02 * k)),
                "prev": f"{instance}k{k - 1}" if k > first else "",
                "next": f"{instance}k{k + 1}" if k < last else "",
                "num_lidar_pts": lidar,
                "num_radar_pts": radar,
            }
        )


def make_sweep(tables, data, seed=0):
    """Return a sweep (N, 5) float32 in the sensor's axes.

    Each label with points has as many inside its box, at 90 % of its size, with the row of the
    label modulo 32 as ring. Returns of the vehicle itself follow.
    """
    rng = np.random.default_rng(seed)
    pose = next(r for r in tables["ego_pose"] if r["token"] == data["ego_pose_token"])
    mount = next(r for r in tables["calibrated_sensor"] if r["token"] == data["calibrated_sensor_token"])
    parts = []
    for i, row in enumerate(tables["sample_annotation"]):
        if row["sample_token"] == data["sample_token"] and row["num_lidar_pts"]:
            w, l, h = row["size"]  # noqa: E741
            inside = rng.uniform(-0.45, 0.45, (row["num_lidar_pts"], 3)) * [l, w, h]
            points = to_rotation(row).apply(inside) + row["translation"]
            for frame in pose, mount:
                points = to_rotation(frame).apply(points - frame["translation"], inverse=True)
            parts.append(np.column_stack([points, np.full((len(points), 2), [100, i % 32])]))
    own = np.column_stack([rng.uniform(-0.9, 0.9, (50, 3)), np.full((50, 2), 255)])
    return np.concatenate([*parts, own]).astype(np.float32)


def save(root: Path, tables, version=VERSION, sweeps=True):
    """Write the tables, with a row on several lines as in nuScenes, and the key sweeps."""
    for name, rows in tables.items():
        path = root / version / f"{name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(rows, indent=0))
    for data in tables["sample_data"] if sweeps else ():
        path = root / data["filename"]
        if data["filename"].startswith("samples/LIDAR_TOP"):
            path.parent.mkdir(parents=True, exist_ok=True)
            make_sweep(tables, data).tofile(path)
    return root


def find_category(tables, annotation):
    instance = next(r for r in tables["instance"] if r["token"] == annotation["instance_token"])
    return list(SIZES)[int(instance["category_token"][1:])]


def make_results(tables, names, seed=1, noise=0.4):
    """Return {sample: boxes} in the format of a submission.

    The boxes are labels with noise, missed, duplicated or with another class, and false positives.

    Args:
        names: {category: class}.
    """
    rng = np.random.default_rng(seed)
    results = {row["token"]: [] for row in tables["sample"]}
    known = [name for names in ATTRIBUTES.values() for name in names]
    for row in tables["sample_annotation"]:
        category = find_category(tables, row)
        name = names.get(category, "bicycle")  # a rack or an animal, misclassified
        for _ in range(rng.choice([0, 1, 1, 1, 2])):
            deviation = noise * rng.uniform(0.1, 2)
            if rng.random() < 0.1:
                name = str(rng.choice(list(names.values())))
            attributes = [known[int(t[1:])] for t in row["attribute_tokens"]]
            if rng.random() < 0.4:
                attributes = [str(rng.choice(known))]
            results[row["sample_token"]].append(
                {
                    "sample_token": row["sample_token"],
                    "translation": (row["translation"] + rng.normal(0, deviation, 3)).tolist(),
                    "size": (np.array(row["size"]) * rng.uniform(0.8, 1.2, 3)).tolist(),
                    "rotation": to_wxyz(to_rotation(row) * Rotation.from_euler("z", rng.normal(0, deviation))),
                    "velocity": (rng.normal(0, 2, 2) if rng.random() < 0.9 else np.full(2, np.nan)).tolist(),
                    "detection_name": name,
                    "detection_score": float(rng.uniform(0.01, 1)),
                    "attribute_name": attributes[0] if attributes else "",
                }
            )
    return results
