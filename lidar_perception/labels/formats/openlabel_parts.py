"""The parts of OpenLABEL files: coordinate systems, cuboids in them, and named values.

A system has a parent and its pose there (pose_wrt_parent), or a frame has a transform between two.
A value is {"name": ..., "val": ...} in a list for its kind: num, text, boolean, vec.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.boxes import to_matrices
from lidar_perception.types import InputError

LIDAR, CAMERA, FIXED = "lidar", "camera", "odom"
LEAN = 1e-9  # of a box whose z axis is not up


def quaternion(yaw: float) -> list[float]:
    """[qx qy qz qw] of a turn about z."""
    return [0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]


def box_of(val: Sequence[float], to_lidar: np.ndarray) -> tuple[list[float], bool]:
    """Convert a cuboid to a box.

    Args:
        val: 10 numbers [x y z qx qy qz qw sx sy sz], or 9 with angles about x, y and z, the turn
            about x first, instead of the quaternion.
        to_lidar: (4, 4) from the cuboid's coordinate system to the LiDAR's.

    Returns: [x y z l w h yaw] in the LiDAR's system, and whether the cuboid's z axis is up there.
    The height is the size along the axis that is closest to the vertical: y in a camera's system (x
    right, y down, z ahead). Of the other two the first is the length, as in KITTI and ISO 8855.
    """
    if len(val) not in (9, 10):
        raise ValueError(f"a cuboid of {len(val)} numbers, where it needs 10 or 9")
    axes = to_lidar[:3, :3] @ (turned(val[3:7]) if len(val) == 10 else _turned(*val[3:6]))
    x, y, z = (to_lidar[:3, :3] @ np.array(val[:3], float) + to_lidar[:3, 3]).tolist()
    up = 2 - int(np.abs(axes[2, ::-1]).argmax())
    ahead, across = (axis for axis in range(3) if axis != up)
    same = np.array_equal(to_lidar, np.eye(4))
    yaw = (2 * math.atan2(val[5], val[6]) if same and len(val) == 10 and val[3] == val[4] == 0
           else math.atan2(axes[1, ahead], axes[0, ahead]))
    yaw = (yaw + math.pi) % (2 * math.pi) - math.pi if abs(yaw) > math.pi else yaw
    sizes = [float(size) for size in val[-3:]]
    return ([x, y, z, sizes[ahead], sizes[across], sizes[up], yaw],
            bool(axes[2, 2] > 1 - LEAN))


def has_size(cuboid: dict[str, Any]) -> bool:
    """Return False for a cuboid none of whose sizes is above 0, as KITTI's DontCare has them."""
    return not all(size <= 0 for size in cuboid["val"][-3:])


def regions_of(data: dict[str, Any]) -> list[list[float]]:
    """List the 2D boxes [left top right bottom] of an object's data, in pixels of the first camera
    that is named."""
    boxes = [box for box in data.get("bbox", ()) if len(box["val"]) == 4]
    cameras = [box.get("coordinate_system") for box in boxes]
    return [[x - w / 2, y - h / 2, x + w / 2, y + h / 2] for box, camera in zip(boxes, cameras)
            if camera == cameras[0] for x, y, w, h in [map(float, box["val"])]]


def turned(quaternion: Sequence[float]) -> np.ndarray:
    """(3, 3) of [qx qy qz qw]."""
    return to_matrices(np.roll(np.array(quaternion, float).reshape(1, 4), 1))[0]


def _turned(x: float, y: float, z: float) -> np.ndarray:
    """(3, 3) of a turn about x, then one about y, then one about z."""
    a, b, c = (turned([*(math.sin(angle / 2) * np.eye(3)[i]), math.cos(angle / 2)])
               for i, angle in enumerate((x, y, z)))
    return c @ b @ a


def to_lidar(name: str, systems: dict[str, Any], frame: dict[str, Any], own: Frame,
             where: str) -> np.ndarray:
    """Return (4, 4) from the coordinate system of this name, "" for that of the LiDAR, by the poses
    of systems and of the frame, or by the recording's own pose; from a camera of a file without a
    LiDAR by the recording's calibration. InputError where they are not connected."""
    lidar = lidar_of(systems, where)
    if name in ("", lidar):
        return np.eye(4)
    calibration = own.calibration() if _is_camera(name) and lidar not in systems else None
    if calibration is not None:
        return np.linalg.inv(calibration.lidar_to_camera)
    roots = []
    for start in (name, lidar):
        place, at = np.eye(4), start
        for _ in systems:
            if at not in systems:
                raise InputError(f"{where} does not define the coordinate system {at!r}, in which "
                                 "it has a cuboid; write the file again")
            if not (parent := systems[at].get("parent")):
                break
            place, at = _pose(at, parent, systems, frame, own, where) @ place, parent
        roots.append((at, place))
    if roots[0][0] != roots[1][0]:
        raise InputError(f"{where}: nothing says where {name!r} is from {lidar!r}")
    return np.linalg.inv(roots[1][1]) @ roots[0][1]


def lidar_of(systems: dict[str, Any], where: str) -> str:
    """Return the name of the LiDAR's coordinate system. InputError if several may be it."""
    sensors = [name for name, s in systems.items()
               if s.get("type") == "sensor_cs" and not _is_camera(name)]
    like = [name for name in sensors if any(word in name.lower() for word in
                                            ("lidar", "velo", "laser"))] or sensors
    if len(like) > 1:
        raise InputError(f"{where} has several sensors that may be the LiDAR: {', '.join(like)}; "
                         f"rename the right one to {LIDAR!r}, and give the others other names")
    return like[0] if like else LIDAR


def _is_camera(name: str) -> bool:
    return "cam" in name.lower()


def _pose(name: str, parent: str, systems: dict[str, Any], frame: dict[str, Any], own: Frame,
          where: str) -> np.ndarray:
    for transform in frame.get("frame_properties", {}).get("transforms", {}).values():
        if transform["src"] == name and transform["dst"] == parent:
            return _matrix(transform["transform_src_to_dst"])
    if "pose_wrt_parent" in systems[name]:
        return _matrix(systems[name]["pose_wrt_parent"])
    pose = own.pose()
    if pose is None:
        raise InputError(f"{where}: nothing says where {name!r} is in {parent!r} in frame "
                         f"{own.index}")
    return pose


def _matrix(data: dict[str, Any]) -> np.ndarray:
    if "matrix4x4" in data:
        return np.array(data["matrix4x4"], float).reshape(4, 4)
    pose = np.eye(4)
    pose[:3, :3] = turned(data["quaternion"])
    pose[:3, 3] = data["translation"]
    return pose


def coordinate_systems(frames: Sequence[Frame]) -> dict[str, Any]:
    """coordinate_systems and streams of a drive: the LiDAR's, and where they are known a fixed one
    and the camera's."""
    calibration = frames[0].calibration() if frames else None
    posed = bool(frames) and frames[0].pose() is not None
    lidar: dict[str, Any] = {"type": "sensor_cs", "parent": FIXED if posed else "", "children": []}
    systems: dict[str, Any] = {LIDAR: lidar}
    streams: dict[str, Any] = {LIDAR: {"type": "lidar"}}
    if posed:
        systems[FIXED] = {"type": "scene_cs", "parent": "", "children": [LIDAR]}
    if calibration is not None:
        pose = np.linalg.inv(calibration.lidar_to_camera)
        lidar["children"] = [CAMERA]
        systems[CAMERA] = {"type": "sensor_cs", "parent": LIDAR, "children": [],
                           "pose_wrt_parent": {"matrix4x4": pose.ravel().tolist()}}
        streams[CAMERA] = {"type": "camera", "stream_properties": {"intrinsics_pinhole": {
            "width_px": calibration.width, "height_px": calibration.height,
            "camera_matrix_3x4": calibration.intrinsics.ravel().tolist()}}}
    return {"coordinate_systems": systems, "streams": streams}


def transforms(frame: Frame) -> dict[str, Any]:
    """frame_properties of the pose of the LiDAR in a fixed frame, where there is one."""
    pose = frame.pose()
    return {} if pose is None else {"transforms": {f"{LIDAR}_to_{FIXED}": {
        "src": LIDAR, "dst": FIXED,
        "transform_src_to_dst": {"matrix4x4": pose.ravel().tolist()}}}}


def named(values: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """A JSON object as values with names, by kind; what is of no kind as text, NAME.json."""
    found: dict[str, list[dict[str, Any]]] = {}
    for name, value in values.items():
        kind = next((kind for kind, fits in KINDS.items() if fits(value)), "")
        found.setdefault(kind or "text", []).append(
            {"name": name if kind else f"{name}.json", "val": value if kind else json.dumps(value)})
    return found


def from_named(lists: dict[str, Any]) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """The inverse of named(), and beside it what is no plain value, by kind."""
    values: dict[str, Any] = {}
    rest: dict[str, list[Any]] = {}
    for kind, items in lists.items():
        for item in items:
            if kind not in KINDS or set(item) != {"name", "val"}:
                rest.setdefault(kind, []).append(item)
            elif kind == "text" and item["name"].endswith(".json"):
                values[item["name"].removesuffix(".json")] = json.loads(item["val"])
            else:
                values[item["name"]] = item["val"]
    return values, rest


def _number(value: Any) -> bool:
    """Whether other readers have a number for it, too: they have no integers of 400 digits."""
    return (isinstance(value, int | float) and not isinstance(value, bool)
            and abs(value) <= sys.float_info.max)


KINDS = {"boolean": lambda v: isinstance(v, bool), "num": _number,
         "text": lambda v: isinstance(v, str),
         "vec": lambda v: isinstance(v, list) and len(v) > 0 and all(map(_number, v))}


def intervals(numbers: list[int]) -> list[dict[str, int]]:
    """Runs of numbers without a gap."""
    found: list[dict[str, int]] = []
    for number in sorted(set(numbers)):
        if found and found[-1]["frame_end"] == number - 1:
            found[-1]["frame_end"] = number
        else:
            found.append({"frame_start": number, "frame_end": number})
    return found
