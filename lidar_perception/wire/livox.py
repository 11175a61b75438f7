"""Vectorized conversion of Livox CustomMsg to PointCloud2, and from ROS 1 to CDR.

All Livox packages define the same message: a header, timebase, point_num, lidar_id, rsvd, and
points of offset_time [ns], x y z [m], reflectivity [0..255], tag and line.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import SECOND_NS, make_header

FIELDS = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
PACKED = np.dtype([(name, f"<{code}") for name, code in FIELDS.items()])  # layout in ROS 1
OFFSETS = [0, 4, 8, 12, 16, 17, 18]  # offsets of the fields of a point, in bytes
POINT_BYTES = 20  # size of a point in CDR, where each point starts at a multiple of 4
FIXED_BYTES = 16  # size of the fields from timebase to rsvd


def decode_livox(data: bytes) -> Any:
    """Convert a CustomMsg in CDR to a PointCloud2 with all fields.

    Raises:
        InputError: The message is damaged.
    """
    try:
        order = "<" if data[1] & 1 else ">"
        seconds, nanoseconds, size = struct.unpack_from(f"{order}iII", data, 4)
        frame_id = bytes(data[16 : 16 + size]).rstrip(b"\0").decode(errors="replace")
        offset = 4 + _align(12 + size) + FIXED_BYTES
        (count,) = struct.unpack_from(f"{order}I", data, offset)
        points = bytes(data[offset + 4 :])
    except (struct.error, IndexError) as error:
        raise InputError(f"{len(data)} bytes are not a valid Livox CustomMsg ({error})") from None
    if len(points) < count * POINT_BYTES - 1:  # the last point has no padding
        raise InputError(
            f"the Livox CustomMsg is truncated: {count} points need "
            f"{count * POINT_BYTES - 1} bytes, the message has {len(points)}"
        )
    dtype = np.dtype(
        {
            "names": [*FIELDS],
            "formats": [f"{order}{code}" for code in FIELDS.values()],
            "offsets": OFFSETS,
            "itemsize": POINT_BYTES,
        }
    )
    header = make_header(seconds * SECOND_NS + nanoseconds, frame_id, make_bag_message)
    return from_array(np.frombuffer(points + b"\0", dtype, count), header, make_bag_message)


def convert_livox_ros1_to_cdr(data: bytes) -> bytes:
    """Convert a serialized ROS 1 CustomMsg to CDR.

    Raises:
        ValueError, struct.error: The message is damaged.
    """
    (size,) = struct.unpack_from("<I", data, 12)  # follows seq and stamp in the header
    start = 16 + size
    (count,) = struct.unpack_from("<I", data, start + FIXED_BYTES)
    packed_points = np.frombuffer(data, PACKED, count, start + FIXED_BYTES + 4)
    padded_points = np.zeros((count, POINT_BYTES), np.uint8)
    padded_points[:, : PACKED.itemsize] = packed_points.view(np.uint8).reshape(count, PACKED.itemsize)
    head = data[4:12] + struct.pack("<I", size + 1) + data[16:start] + b"\0"
    return b"".join(
        (
            b"\0\1\0\0",
            head.ljust(_align(len(head)), b"\0"),
            data[start : start + FIXED_BYTES + 4],
            padded_points.tobytes(),
        )
    )


def _align(size: int) -> int:
    """Round up to a multiple of 8."""
    return -(-size // 8) * 8
