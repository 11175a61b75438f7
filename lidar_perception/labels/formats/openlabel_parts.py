"""Parts of OpenLABEL files: coordinate systems, cuboids in them, and named values.

The pose of a coordinate system in its parent is in pose_wrt_parent, or is a transform of each
frame. A value is {"name": ..., "val": ...} in the list of its type: num, text, boolean or vec.
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

LIDAR, CAMERA, FIXED = "lidar", "camera", "odom"  # names of written coordinate systems
MAX_TILT = 1e-9  # maximum of 1 - cos(angle between the z axis and the vertical) of an upright cuboid


def cuboid_to_box(val: Sequence[float], to_lidar: np.ndarray) -> tuple[list[float], bool]:
    """Convert a cuboid to a box.

    The height is the size along the axis that is closest to the vertical; for cuboids in a camera's
    system (x right, y down, z forward) this is y. The length is the size along the first of the
    other two axes, as in KITTI and ISO 8855.

    Args:
        val: 10 numbers [x y z qx qy qz qw sx sy sz], or 9 numbers with three angles instead of the
            quaternion; the rotations are about x, then y, then z.
        to_lidar: (4, 4) transform from the cuboid's coordinate system to the LiDAR's.

    Returns:
        The box [x y z l w h yaw] in the LiDAR's system, and True if the cuboid's z axis points up.
    """
    if len(val) not in (9, 10):
        raise ValueError(f"a cuboid has {len(val)} numbers, expected 10 or 9")
    axes = to_lidar[:3, :3] @ (quaternion_to_matrix(val[3:7]) if len(val) == 10 else _euler_to_matrix(*val[3:6]))
    x, y, z = (to_lidar[:3, :3] @ np.array(val[:3], float) + to_lidar[:3, 3]).tolist()
    up_axis = 2 - int(np.abs(axes[2, ::-1]).argmax())
    length_axis, width_axis = (axis for axis in range(3) if axis != up_axis)
    is_identity = np.array_equal(to_lidar, np.eye(4))
    yaw = (
        2 * math.atan2(val[5], val[6])
        if is_identity and len(val) == 10 and val[3] == val[4] == 0
        else math.atan2(axes[1, length_axis], axes[0, length_axis])
    )
    yaw = (yaw + math.pi) % (2 * math.pi) - math.pi if abs(yaw) > math.pi else yaw
    sizes = [float(size) for size in val[-3:]]
    return ([x, y, z, sizes[length_axis], sizes[width_axis], sizes[up_axis], yaw], bool(axes[2, 2] > 1 - MAX_TILT))


def has_size(cuboid: dict[str, Any]) -> bool:
    """Return True if a cuboid has a positive size, unlike those of KITTI's DontCare regions."""
    return not all(size <= 0 for size in cuboid["val"][-3:])


def find_regions(data: dict[str, Any]) -> list[list[float]]:
    """Return the 2D boxes [left top right bottom] of an object in the image of its first camera."""
    boxes = [box for box in data.get("bbox", ()) if len(box["val"]) == 4]
    cameras = [box.get("coordinate_system") for box in boxes]
    return [
        [x - w / 2, y - h / 2, x + w / 2, y + h / 2]
        for box, camera in zip(boxes, cameras)
        if camera == cameras[0]
        for x, y, w, h in [map(float, box["val"])]
    ]


def quaternion_to_matrix(quaternion: Sequence[float]) -> np.ndarray:
    """Convert a quaternion [qx qy qz qw] to a rotation matrix (3, 3)."""
    return to_matrices(np.roll(np.array(quaternion, float).reshape(1, 4), 1))[0]


def _euler_to_matrix(x: float, y: float, z: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) for rotations about x, then y, then z, in radians."""
    a, b, c = (
        quaternion_to_matrix([*(math.sin(angle / 2) * np.eye(3)[i]), math.cos(angle / 2)])
        for i, angle in enumerate((x, y, z))
    )
    return c @ b @ a


def find_transform_to_lidar(
    name: str, systems: dict[str, Any], frame: dict[str, Any], recorded_frame: Frame, source: str
) -> np.ndarray:
    """Return the transform (4, 4) from a coordinate system to that of the LiDAR.

    It is computed from the poses in the file; a missing pose is taken from the recording. For a
    camera in a file without a LiDAR, the calibration of the recording is used.

    Args:
        name: Name of the coordinate system, "" for the LiDAR's.
        systems: Coordinate systems of the file.
        frame: Content of the frame in the file.
        recorded_frame: The same frame of the recording.
        source: Name of the file, for error messages.

    Raises:
        InputError: The systems are not connected.
    """
    lidar = find_lidar_system(systems, source)
    if name in ("", lidar):
        return np.eye(4)
    calibration = recorded_frame.calibration() if _is_camera(name) and lidar not in systems else None
    if calibration is not None:
        return np.linalg.inv(calibration.lidar_to_camera)
    roots = []
    for start in (name, lidar):
        transform, system = np.eye(4), start
        for _ in systems:
            if system not in systems:
                raise InputError(
                    f"{source} does not define the coordinate system {system!r} of a cuboid; export the file again"
                )
            if not (parent := systems[system].get("parent")):
                break
            pose = _find_pose(system, parent, systems, frame, recorded_frame, source)
            transform, system = pose @ transform, parent
        roots.append((system, transform))
    if roots[0][0] != roots[1][0]:
        raise InputError(
            f"{source}: the coordinate systems {name!r} and {lidar!r} are not connected; export the file again"
        )
    return np.linalg.inv(roots[1][1]) @ roots[0][1]


def find_lidar_system(systems: dict[str, Any], source: str) -> str:
    """Return the name of the LiDAR's coordinate system. Raise InputError if there are several candidates."""
    sensors = [name for name, s in systems.items() if s.get("type") == "sensor_cs" and not _is_camera(name)]
    lidars = [name for name in sensors if any(word in name.lower() for word in ("lidar", "velo", "laser"))] or sensors
    if len(lidars) > 1:
        raise InputError(
            f"{source} has several sensors that may be the LiDAR: {', '.join(lidars)}; "
            f"rename the LiDAR to {LIDAR!r}, and give the others names without it"
        )
    return lidars[0] if lidars else LIDAR


def _is_camera(name: str) -> bool:
    return "cam" in name.lower()


def _find_pose(
    name: str, parent: str, systems: dict[str, Any], frame: dict[str, Any], recorded_frame: Frame, source: str
) -> np.ndarray:
    for transform in frame.get("frame_properties", {}).get("transforms", {}).values():
        if transform["src"] == name and transform["dst"] == parent:
            return _parse_transform(transform["transform_src_to_dst"])
    if "pose_wrt_parent" in systems[name]:
        return _parse_transform(systems[name]["pose_wrt_parent"])
    pose = recorded_frame.pose()
    if pose is None:
        raise InputError(
            f"{source}: the pose of {name!r} in {parent!r} is missing in frame {recorded_frame.index}; "
            "export the file again"
        )
    return pose


def _parse_transform(data: dict[str, Any]) -> np.ndarray:
    if "matrix4x4" in data:
        return np.array(data["matrix4x4"], float).reshape(4, 4)
    pose = np.eye(4)
    pose[:3, :3] = quaternion_to_matrix(data["quaternion"])
    pose[:3, 3] = data["translation"]
    return pose


def make_coordinate_systems(frames: Sequence[Frame]) -> dict[str, Any]:
    """Make coordinate_systems and streams of a drive.

    They contain the LiDAR, a fixed system if the recording has poses, and the camera if it has a
    calibration.
    """
    calibration = frames[0].calibration() if frames else None
    has_poses = bool(frames) and frames[0].pose() is not None
    lidar: dict[str, Any] = {"type": "sensor_cs", "parent": FIXED if has_poses else "", "children": []}
    systems: dict[str, Any] = {LIDAR: lidar}
    streams: dict[str, Any] = {LIDAR: {"type": "lidar"}}
    if has_poses:
        systems[FIXED] = {"type": "scene_cs", "parent": "", "children": [LIDAR]}
    if calibration is not None:
        pose = np.linalg.inv(calibration.lidar_to_camera)
        lidar["children"] = [CAMERA]
        systems[CAMERA] = {
            "type": "sensor_cs",
            "parent": LIDAR,
            "children": [],
            "pose_wrt_parent": {"matrix4x4": pose.ravel().tolist()},
        }
        streams[CAMERA] = {
            "type": "camera",
            "stream_properties": {
                "intrinsics_pinhole": {
                    "width_px": calibration.width,
                    "height_px": calibration.height,
                    "camera_matrix_3x4": calibration.intrinsics.ravel().tolist(),
                }
            },
        }
    return {"coordinate_systems": systems, "streams": streams}


def make_transforms(frame: Frame) -> dict[str, Any]:
    """Make frame_properties with the pose of the LiDAR in a fixed frame; {} without a pose."""
    pose = frame.pose()
    return (
        {}
        if pose is None
        else {
            "transforms": {
                f"{LIDAR}_to_{FIXED}": {
                    "src": LIDAR,
                    "dst": FIXED,
                    "transform_src_to_dst": {"matrix4x4": pose.ravel().tolist()},
                }
            }
        }
    )


def to_named_values(values: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Convert a JSON object to named values by type; values of other types become a text NAME.json."""
    values_by_type: dict[str, list[dict[str, Any]]] = {}
    for name, value in values.items():
        value_type = next((value_type for value_type, is_type in TYPES.items() if is_type(value)), "")
        values_by_type.setdefault(value_type or "text", []).append(
            {"name": name if value_type else f"{name}.json", "val": value if value_type else json.dumps(value)}
        )
    return values_by_type


def parse_named_values(lists: dict[str, Any]) -> tuple[dict[str, Any], dict[str, list[Any]]]:
    """Parse named values, the inverse of to_named_values.

    Returns:
        The plain values by name, and all other items by type.
    """
    values: dict[str, Any] = {}
    other_items: dict[str, list[Any]] = {}
    for value_type, items in lists.items():
        for item in items:
            if value_type not in TYPES or set(item) != {"name", "val"}:
                other_items.setdefault(value_type, []).append(item)
            elif value_type == "text" and item["name"].endswith(".json"):
                values[item["name"].removesuffix(".json")] = json.loads(item["val"])
            else:
                values[item["name"]] = item["val"]
    return values, other_items


def _is_number(value: Any) -> bool:
    """Return True for a number in the range of float64; other tools cannot read larger numbers."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


TYPES = {
    "boolean": lambda v: isinstance(v, bool),
    "num": _is_number,
    "text": lambda v: isinstance(v, str),
    "vec": lambda v: isinstance(v, list) and len(v) > 0 and all(map(_is_number, v)),
}


def find_intervals(numbers: list[int]) -> list[dict[str, int]]:
    """Group frame numbers into intervals of consecutive frames."""
    intervals: list[dict[str, int]] = []
    for number in sorted(set(numbers)):
        if intervals and intervals[-1]["frame_end"] == number - 1:
            intervals[-1]["frame_end"] = number
        else:
            intervals.append({"frame_start": number, "frame_end": number})
    return intervals
