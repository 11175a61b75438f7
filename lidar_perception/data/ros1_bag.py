"""Reader of ROS 1 bags that converts messages to CDR of Jazzy's types."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

from lidar_perception.data.bag_metadata import LATCHED_QOS
from lidar_perception.data.storage import Stream, Topic
from lidar_perception.wire.clouds import LIVOX
from lidar_perception.wire.codec import load_typestore
from lidar_perception.wire.livox import convert_livox_ros1_to_cdr

MAGIC = b"#ROSBAG V"
SUFFIX = ".bag"


class Ros1File:
    """A .bag file open for reading, see StorageFile.

    Topics of types that Jazzy lacks cannot be read; their encoding is "ros1". Fields that are new
    since ROS 1 are empty.
    """

    def __init__(self, path: Path):
        # Undocumented in rosbags: if it changes, only ROS 1 bags are affected.
        from rosbags.convert.converter import STATIC_MSGTYPE_RENAMES

        self.reader = AnyReader([path])
        self.reader.open()
        self.recorded = {c.id: c for c in self.reader.connections}
        self.topics = []
        for c in self.reader.connections:
            kind = STATIC_MSGTYPE_RENAMES.get(c.msgtype, c.msgtype)
            self.topics.append(
                Topic(
                    c.id,
                    c.topic,
                    kind,
                    "cdr" if kind in load_typestore().fielddefs else "ros1",
                    [LATCHED_QOS] if getattr(c.ext, "latching", 0) else [],
                    c.msgcount,
                )
            )
        cache: dict[str, object] = {}
        self.converters = {
            topic.id: self._make_converter(self.recorded[topic.id].msgtype, topic.type, cache)
            for topic in self.topics
            if topic.encoding == "cdr"
        }
        for topic in self.topics:
            if topic.type in LIVOX:  # slow in rosbags, which converts point by point
                self.converters[topic.id] = convert_livox_ros1_to_cdr
        self.times = (self.reader.start_time, self.reader.end_time - 1) if self.reader.message_count else None

    def close(self) -> None:
        self.reader.close()

    def messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield (topic id, time, CDR bytes) of topics with start <= time < stop, in order of
        time."""
        connections = [self.recorded[number] for number in ids]
        for connection, time, data in self.reader.messages(connections, start, stop):
            yield connection.id, time, bytes(self.converters[connection.id](data))

    def _make_converter(self, recorded: str, wanted: str, cache: dict[str, object]) -> Callable[[Any], Any]:
        from rosbags.convert.converter import is_same_wireformat, migrate_bytes

        if is_same_wireformat(self.reader.typestore, load_typestore(), recorded, wanted):
            return partial(load_typestore().ros1_to_cdr, typename=wanted)
        return partial(
            migrate_bytes, self.reader.typestore, load_typestore(), recorded, wanted, cache, src_is2=False, dst_is2=True
        )
