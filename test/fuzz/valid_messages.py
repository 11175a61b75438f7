"""Small valid messages and their mutation; thousands can be tried per second."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from fuzz.case import pick
from fuzz.mutation import FLOATS, INTEGERS, mutate_message
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.types import PEDESTRIAN, SENSOR_HEIGHT, GroundTruth
from lidar_perception.wire.codec import decode, encode, make_bag_message
from lidar_perception.wire.messages import make_camera_info, make_extrinsics, make_truth_markers
from msg_utils.point_cloud2 import CloudError, add_columns, from_array, to_array
from msg_utils.stamps import make_header

CLOUD = "sensor_msgs/msg/PointCloud2"
STAMP = 1_700_000_000_000_000_000
PERSON = np.array([8.0, 0.5, -0.85, 0.6, 0.6, 1.7, 0.0])  # [x y z l w h yaw]
KINDS = (
    "f",
    "fi",
    "velodyne",
    "double",
    "big-endian",
    "rows",
    "padded",
    "columns",
    "columns",
    "columns",
    "empty",
    "one",
)
PLAIN = [("x", "<f4"), ("y", "<f4"), ("z", "<f4")]
LAYOUTS: dict[str, Any] = {
    "fi": [*PLAIN, ("intensity", "<f4")],
    "velodyne": [*PLAIN, ("intensity", "<f4"), ("ring", "<u2"), ("time", "<f4")],
    "double": [(name, "<f8") for name in ("x", "y", "z", "timestamp")],
    "big-endian": [(name, ">f4") for name in ("x", "y", "z", "intensity")],
    "padded": dict(
        names=["z", "x", "y", "reflectivity"],
        formats=["<f4", "<f4", "<f4", "<u1"],
        offsets=[4, 16, 24, 33],
        itemsize=48,
    ),
}


@functools.cache
def make_points(seed: int = 0, people: int = 3, ground: int = 500) -> np.ndarray:
    """Return points (N, 3) float32 of level ground, people (the first one fills PERSON) and a
    wall."""
    rng = np.random.default_rng(seed)
    parts = [rng.uniform([2, -10, -SENSOR_HEIGHT], [22, 10, -SENSOR_HEIGHT + 0.02], (ground, 3))]
    for i in range(people):
        body = rng.uniform([-0.2, -0.2, -0.82], [0.2, 0.2, 0.85], (90, 3))
        parts.append(body + PERSON[:3] + [3.0 * i, -2.5 * i, 0.0])
    parts.append(rng.uniform([18, -4, -1.7], [18.1, 4, 0.5], (150, 3)))
    return np.concatenate(parts).astype(np.float32)


def make_message_header() -> Any:
    """Return the header of all messages."""
    return make_header(STAMP, "lidar", make_bag_message)


def make_cloud(kind: str = "columns") -> Any:
    """Return a valid PointCloud2. kind: key of KINDS."""
    xyz = make_points()[: {"empty": 0, "one": 1}.get(kind)]
    points = np.zeros(len(xyz), np.dtype(LAYOUTS.get(kind, PLAIN)))
    for i, name in enumerate("xyz"):
        points[name] = xyz[:, i]
    message = from_array(points, make_message_header(), make_bag_message, height=4 if kind == "rows" else 1)
    if kind == "columns":
        body = (xyz[:, 2] > -SENSOR_HEIGHT + 0.05).astype("u1")
        ids = np.where(body, 1 + np.arange(len(xyz)) // 90, 0).astype("u4")
        message = add_columns(message, make_bag_message, ground=1 - body, in_view=np.ones_like(body), cluster_id=ids)
    return message


@functools.cache
def make_valid_message(kind: str) -> bytes:
    """Return the CDR of a valid message of a type."""
    if kind == CLOUD:
        return encode(make_cloud())
    if kind == "visualization_msgs/msg/MarkerArray":
        truth = GroundTruth.of([PERSON], [PEDESTRIAN], [{"track_id": 3}])
        return encode(make_truth_markers(truth, make_message_header(), make_bag_message))
    if kind == "sensor_msgs/msg/CameraInfo":
        return encode(
            make_camera_info(FORWARD_CAMERA, make_header(STAMP, "camera_optical", make_bag_message), make_bag_message)
        )
    if kind == "geometry_msgs/msg/TransformStamped":
        return encode(make_extrinsics(FORWARD_CAMERA, make_message_header(), make_bag_message))
    if kind == "geometry_msgs/msg/PointStamped":
        x, y, z = map(float, PERSON[:3])
        return encode(
            make_bag_message(
                kind, header=make_message_header(), point=make_bag_message("geometry_msgs/msg/Point", x=x, y=y, z=z)
            )
        )
    if kind == "nav_msgs/msg/Odometry":
        message = make_bag_message(kind, header=make_message_header(), child_frame_id="lidar")
        message.pose.pose.orientation.w = 1.0
        return encode(message)
    raise LookupError(f"there is no valid message of type {kind}")


def mutate_valid_message(kind: str, rng: np.random.Generator) -> tuple[bytes, str]:
    """Return the CDR of a message with one to three changes that leave it decodable, and their
    description."""
    changes = []
    if kind == CLOUD:
        form = pick(rng, KINDS)
        message = make_cloud(form)
        changes.append(form)
    else:
        message = decode(make_valid_message(kind), kind)
    for _ in range(int(rng.integers(1, 4))):
        change = pick(rng, CLOUD_CHANGES) if kind == CLOUD else mutate_message
        changes.append(change(message, rng))
    return encode(message), ", ".join(changes)


def _change_values(message: Any, rng: np.random.Generator) -> str:
    """Set the values of one field, of some points or of all."""
    fields = [f for f in message.fields if 1 <= f.datatype <= 8 and f.offset + 8 <= message.point_step]
    count = len(message.data) // message.point_step if message.point_step else 0
    if not fields or not count:
        return mutate_message(message, rng)
    field = pick(rng, fields)
    order = ">" if message.is_bigendian else "<"
    dtype = np.dtype(order + " i1u1i2u2i4u4f4f8"[2 * field.datatype - 1 : 2 * field.datatype + 1])
    data = np.array(message.data)
    column = np.ndarray(count, dtype, data, field.offset, (message.point_step,))
    value = pick(rng, FLOATS if dtype.kind == "f" else INTEGERS)
    rows = rng.random(count) < pick(rng, (0.01, 0.3, 1.0))
    with np.errstate(over="ignore"):
        column[rows] = np.array(value).astype(dtype) if dtype.kind == "f" else value & np.iinfo(dtype).max
    message.data = data
    return f"{field.name} = {value} in {int(rows.sum())} points"


def _add_column(message: Any, rng: np.random.Generator) -> str:
    """Add a column that the nodes read, with any type and values."""
    try:
        count = len(to_array(message))
    except CloudError:  # an earlier change made the cloud invalid
        return mutate_message(message, rng)
    name = pick(rng, ("ground", "in_view", "cluster_id", "cluster_id", "intensity"))
    kind = pick(rng, ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"))
    how = pick(rng, ("ramp", "extreme", "random", "sparse"))
    values = np.arange(count, dtype=float)
    if how == "extreme":
        values[:] = pick(rng, FLOATS if kind[0] == "f" else INTEGERS)
    elif how == "random":
        values = rng.integers(-5, 2 ** pick(rng, (3, 16, 32)), count).astype(float)
    elif how == "sparse":
        values = np.where(rng.random(count) < 0.01, float(pick(rng, INTEGERS)), 0.0)
    with np.errstate(invalid="ignore", over="ignore"):
        column = values.astype(kind)
    new_message = add_columns(message, make_bag_message, **{name: column})
    for field in ("fields", "point_step", "row_step", "data"):
        setattr(message, field, getattr(new_message, field))
    return f"{name} as {kind}, {how}"


def _change_field(message: Any, rng: np.random.Generator) -> str:
    """Change the description of one field."""
    if not message.fields:
        return mutate_message(message, rng)
    return f"{(f := pick(rng, message.fields)).name}.{mutate_message(f, rng)}"


def _change_layout(message: Any, rng: np.random.Generator) -> str:
    """Make one number of the layout a multiple of another."""
    a, b = rng.permutation(["height", "width", "point_step", "row_step"])[:2]
    factor = pick(rng, (0.5, 1, 2, 3))
    setattr(message, a, int(getattr(message, b) * factor) % 2**32)
    return f"{a} = {factor} {b}"


def _change_data(message: Any, rng: np.random.Generator) -> str:
    data = np.array(message.data)
    size = int(rng.integers(0, len(data) + 20))
    message.data = np.resize(data, size) if len(data) else np.zeros(size, np.uint8)
    return f"{size} bytes of {len(data)}"


CLOUD_CHANGES = (
    _change_values,
    _change_values,
    _change_values,
    _add_column,
    _add_column,
    _change_field,
    _change_layout,
    _change_data,
    mutate_message,
)
