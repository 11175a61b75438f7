"""Livox CustomMsg to PointCloud2, and from ROS 1, without a loop over the points.

The same message is in livox_ros_driver, livox_ros_driver2 and livox_interfaces: a header, timebase,
point_num, lidar_id, rsvd, and points of offset_time [ns], x y z [m], reflectivity [0..255], tag and
line.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import SECOND, header_message

FIELDS = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1",
          "line": "u1"}
PACKED = np.dtype([(name, f"<{kind}") for name, kind in FIELDS.items()])  # as in ROS 1
OFFSETS = [0, 4, 8, 12, 16, 17, 18]  # of the fields in a point, in bytes
POINT_BYTES = 20  # in CDR, where each point begins at a multiple of 4
FIXED_BYTES = 16  # from timebase to rsvd


def livox_cloud(data: bytes) -> Any:
    """Return the PointCloud2 of a CustomMsg in CDR, with all its columns. InputError where it is
    broken."""
    try:
        order = "<" if data[1] & 1 else ">"
        seconds, nanoseconds, size = struct.unpack_from(f"{order}iII", data, 4)
        frame_id = bytes(data[16:16 + size]).rstrip(b"\0").decode(errors="replace")
        at = 4 + _aligned(12 + size) + FIXED_BYTES
        count, = struct.unpack_from(f"{order}I", data, at)
        points = bytes(data[at + 4:])
    except (struct.error, IndexError) as error:
        raise InputError(f"{len(data)} bytes are no Livox CustomMsg ({error})") from None
    if len(points) < count * POINT_BYTES - 1:  # no padding behind the last point
        raise InputError(f"the Livox CustomMsg has {len(points)} bytes where {count} points need "
                         f"{count * POINT_BYTES - 1}; the message was cut")
    kind = np.dtype({"names": [*FIELDS], "formats": [f"{order}{each}" for each in FIELDS.values()],
                     "offsets": OFFSETS, "itemsize": POINT_BYTES})
    header = header_message(seconds * SECOND + nanoseconds, frame_id, bag_message)
    return from_array(np.frombuffer(points + b"\0", kind, count), header, bag_message)


def livox_ros1_to_cdr(data: bytes) -> bytes:
    """Return a CustomMsg of ROS 1 as CDR. ValueError or struct.error where it is broken."""
    size, = struct.unpack_from("<I", data, 12)  # behind the number and the stamp of the header
    at = 16 + size
    count, = struct.unpack_from("<I", data, at + FIXED_BYTES)
    packed = np.frombuffer(data, PACKED, count, at + FIXED_BYTES + 4)
    padded = np.zeros((count, POINT_BYTES), np.uint8)
    padded[:, :PACKED.itemsize] = packed.view(np.uint8).reshape(count, PACKED.itemsize)
    head = data[4:12] + struct.pack("<I", size + 1) + data[16:at] + b"\0"
    return b"".join((b"\0\1\0\0", head.ljust(_aligned(len(head)), b"\0"),
                     data[at:at + FIXED_BYTES + 4], padded.tobytes()))


def _aligned(size: int) -> int:
    return -(-size // 8) * 8
