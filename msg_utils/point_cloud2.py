"""Conversion between sensor_msgs/PointCloud2 and NumPy structured arrays.

Clouds may have any field order, padding, datatypes, counts, byte order and row padding.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

# sensor_msgs/PointField datatypes
DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
CODES = {dtype: code for code, dtype in DATATYPES.items()}
MAX_STEP = 2**20  # maximum bytes per point; NumPy's limit is 2**31


class CloudError(ValueError):
    """Invalid cloud. The message is one line with the problem and the remedy."""


def compute_dtype(msg: Any) -> np.dtype:
    """Return the structured dtype of a cloud's points; its itemsize is point_step.

    Fields without a name are treated as padding.

    Raises:
        CloudError: A datatype is unknown, a field extends beyond point_step, a name is duplicate,
            or point_step is above MAX_STEP.
    """
    if msg.point_step > MAX_STEP:
        raise CloudError(
            f"point_step is {msg.point_step}, but at most {MAX_STEP} bytes per point are supported; "
            "the message is corrupt"
        )
    order = ">" if msg.is_bigendian else "<"
    names, formats, offsets = [], [], []
    for f in msg.fields:
        if not f.name:
            continue
        if f.datatype not in DATATYPES:
            raise CloudError(f"field '{f.name}' has datatype {f.datatype}; sensor_msgs/PointField defines 1 to 8")
        if f.name in names:
            raise CloudError(f"field '{f.name}' exists twice; give each field a unique name")
        base = np.dtype(order + DATATYPES[f.datatype])
        names.append(f.name)
        formats.append((base, (f.count,)) if f.count > 1 else base)
        offsets.append(f.offset)
        if f.offset + base.itemsize * max(f.count, 1) > msg.point_step:
            raise CloudError(
                f"field '{f.name}' at offset {f.offset} extends beyond point_step = "
                f"{msg.point_step}; the driver's field offsets are wrong"
            )
    return np.dtype(dict(names=names, formats=formats, offsets=offsets, itemsize=msg.point_step))


def to_array(msg: Any) -> np.ndarray:
    """Return the points of a cloud, (height * width,) structured, row by row.

    The result is a read-only view of the message's buffer, or a copy if rows are padded.

    Raises:
        CloudError: The buffer is too short for height, width, point_step and row_step.
    """
    count = msg.height * msg.width
    if count == 0:
        return np.zeros(0, compute_dtype(msg) if msg.point_step else np.dtype([]))
    if msg.point_step == 0:
        raise CloudError(f"point_step is 0 for {count} points; the message is corrupt")
    dtype = compute_dtype(msg)
    data, row_bytes = np.frombuffer(msg.data, np.uint8), msg.width * msg.point_step
    row_step = compute_row_step(msg)
    if row_step < row_bytes:
        raise CloudError(f"row_step = {row_step} is less than width x point_step = {row_bytes}")
    required_bytes = (msg.height - 1) * row_step + row_bytes
    if len(data) < required_bytes:
        raise CloudError(
            f"data has {len(data)} bytes, but height {msg.height} x width "
            f"{msg.width} x point_step {msg.point_step} requires {required_bytes}; "
            "the message is truncated"
        )
    rows = np.ndarray((msg.height, msg.width), dtype, data, strides=(row_step, msg.point_step))
    rows.flags.writeable = False
    return rows.reshape(count)


def compute_row_step(msg: Any) -> int:
    """Return the distance in bytes between two rows of a cloud.

    Some drivers set row_step to 0 or to the size of the cloud; their rows have no padding.
    """
    row_bytes, row_step = msg.width * msg.point_step, msg.row_step
    cloud_bytes = msg.height * row_bytes
    is_cloud_size = row_step == cloud_bytes <= len(msg.data) < (msg.height - 1) * cloud_bytes + row_bytes
    return int(row_bytes if msg.height <= 1 or row_step == 0 or is_cloud_size else row_step)


def read_columns(points: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Return the named fields as (N, len(names)) float32.

    Raises:
        CloudError: A field is missing or has several numbers per point.
    """
    for name in names:
        if name not in (points.dtype.names or ()):
            raise CloudError(f"the cloud has no field '{name}'; it has {', '.join(points.dtype.names or ()) or 'none'}")
        if points.dtype[name].shape:
            raise CloudError(f"field '{name}' has count > 1; expected one number per point")
    columns = np.empty((len(points), len(names)), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes inf
        for i, name in enumerate(names):
            columns[:, i] = points[name]
    return columns


def read_xyz(points: np.ndarray) -> np.ndarray:
    """Return the coordinates (N, 3) float32 of all points, including invalid returns.

    Raises:
        CloudError: x, y or z is missing or not a floating-point field.
    """
    xyz = read_columns(points, ("x", "y", "z"))
    for name in "xyz":
        if points.dtype[name].kind != "f":
            raise CloudError(f"field '{name}' has type {points.dtype[name]}; expected metres as float32 or float64")
    return xyz


def from_array(points: np.ndarray, header: Any, make: Any, *, height: int = 1, is_dense: bool = True) -> Any:
    """Build a PointCloud2 from a structured array (N,); N must be a multiple of height."""
    width = len(points) // height
    if width * height != len(points):
        raise ValueError(f"{len(points)} points cannot be split into {height} rows")
    data = np.ascontiguousarray(points).view(np.uint8).reshape(-1)
    byte_orders = {points.dtype[n].base.byteorder for n in points.dtype.names or ()} - {"|"}
    if len(byte_orders) > 1:
        raise ValueError("the fields have different byte orders, but a cloud has one; convert them to the same")
    return _make_cloud(
        header,
        make,
        make_point_fields(points.dtype, make),
        data,
        height=height,
        width=width,
        point_step=points.dtype.itemsize,
        is_bigendian=">" in byte_orders,
        is_dense=is_dense,
    )


def make_point_fields(dtype: np.dtype, make: Any) -> list[Any]:
    """Build the PointField messages of a structured dtype."""
    fields = []
    for name, (field_type, offset, *_) in (dtype.fields or {}).items():
        code = CODES.get(f"{field_type.base.kind}{field_type.base.itemsize}")
        if code is None:
            raise ValueError(f"field '{name}' of type {field_type} has no PointField datatype")
        fields.append(
            make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=offset,
                datatype=code,
                count=int(np.prod(field_type.shape, dtype=int)),
            )
        )
    return fields


def add_columns(msg: Any, make: Any, **new: np.ndarray) -> Any:
    """Return the cloud with additional fields.

    A field with the same name and datatype is overwritten. The bytes of other fields, height,
    width, is_dense and the byte order do not change. The offset of a new field is a multiple of its
    size.

    Args:
        msg: The PointCloud2.
        make: Function that creates messages, see msg_utils.
        new: Values (height * width,) of each field, of a PointField datatype.
    """
    points = to_array(msg)
    byte_order: Literal[">", "<"] = ">" if msg.is_bigendian else "<"
    fields, offset = list(msg.fields), msg.point_step
    names = {f.name: f for f in fields}
    layout = {}
    for name, values in new.items():
        dtype = np.dtype(values.dtype).newbyteorder(byte_order)
        code = CODES[f"{dtype.kind}{dtype.itemsize}"]
        existing_field = names.get(name)
        if existing_field is not None and existing_field.datatype == code and existing_field.count <= 1:
            layout[name] = (existing_field.offset, dtype)
            continue
        fields = [f for f in fields if f.name != name]
        offset = -(-offset // dtype.itemsize) * dtype.itemsize  # aligned as in C structs
        fields.append(make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=code, count=1))
        layout[name] = (offset, dtype)
        offset += dtype.itemsize
    # A point_step that is a multiple of 4 bytes keeps float fields aligned in every point.
    point_step = offset if offset == msg.point_step else -(-offset // 4) * 4
    data = np.zeros((len(points), point_step), np.uint8)
    if len(points):
        source_bytes = np.frombuffer(msg.data, np.uint8)
        if (source_row_step := compute_row_step(msg)) != msg.width * msg.point_step:
            source_bytes = np.ndarray(
                (msg.height, msg.width * msg.point_step), np.uint8, source_bytes, strides=(source_row_step, 1)
            ).reshape(-1)
        data[:, : msg.point_step] = source_bytes[: len(points) * msg.point_step].reshape(-1, msg.point_step)
        for name, (field_offset, dtype) in layout.items():
            np.ndarray(len(points), dtype, data, offset=field_offset, strides=(point_step,))[:] = new[name]
    return _make_cloud(
        msg.header,
        make,
        fields,
        data.reshape(-1),
        height=msg.height,
        width=msg.width,
        point_step=point_step,
        is_bigendian=msg.is_bigendian,
        is_dense=msg.is_dense,
    )


def _make_cloud(
    header: Any,
    make: Any,
    fields: list[Any],
    data: np.ndarray,
    *,
    height: int,
    width: int,
    point_step: int,
    is_bigendian: bool,
    is_dense: bool,
) -> Any:
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=header,
        height=height,
        width=width,
        fields=fields,
        is_bigendian=is_bigendian,
        point_step=point_step,
        row_step=width * point_step if data.size else 0,
        data=data,
        is_dense=is_dense,
    )
