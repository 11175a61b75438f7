"""Reader of ROS 1 bags that converts messages to CDR with the message types of ROS 2 Jazzy."""

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

    Topics whose type does not exist in Jazzy cannot be read; their encoding is "ros1". Fields that
    the ROS 1 message lacks are empty.
    """

    def __init__(self, path: Path):
        # This table is undocumented in rosbags. If it changes, only ROS 1 bags are affected.
        from rosbags.convert.converter import STATIC_MSGTYPE_RENAMES

        self.reader = AnyReader([path])
        self.reader.open()
        self.connection_by_id = {connection.id: connection for connection in self.reader.connections}
        self.topics = []
        for connection in self.reader.connections:
            type_name = STATIC_MSGTYPE_RENAMES.get(connection.msgtype, connection.msgtype)
            self.topics.append(
                Topic(
                    connection.id,
                    connection.topic,
                    type_name,
                    "cdr" if type_name in load_typestore().fielddefs else "ros1",
                    [LATCHED_QOS] if getattr(connection.ext, "latching", 0) else [],
                    connection.msgcount,
                )
            )
        cache: dict[str, object] = {}
        self.converters = {
            topic.id: self._make_converter(self.connection_by_id[topic.id].msgtype, topic.type, cache)
            for topic in self.topics
            if topic.encoding == "cdr"
        }
        for topic in self.topics:
            if topic.type in LIVOX:  # slow in rosbags, which converts point by point
                self.converters[topic.id] = convert_livox_ros1_to_cdr
        self.times = (self.reader.start_time, self.reader.end_time - 1) if self.reader.message_count else None

    def close(self) -> None:
        self.reader.close()

    def read_messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield (topic id, time, CDR bytes) of topics with start <= time < stop, in order of time."""
        connections = [self.connection_by_id[topic_id] for topic_id in ids]
        for connection, time, data in self.reader.messages(connections, start, stop):
            yield connection.id, time, bytes(self.converters[connection.id](data))

    def _make_converter(self, recorded_type: str, target_type: str, cache: dict[str, object]) -> Callable[[Any], Any]:
        from rosbags.convert.converter import is_same_wireformat, migrate_bytes

        if is_same_wireformat(self.reader.typestore, load_typestore(), recorded_type, target_type):
            return partial(load_typestore().ros1_to_cdr, typename=target_type)
        return partial(
            migrate_bytes,
            self.reader.typestore,
            load_typestore(),
            recorded_type,
            target_type,
            cache,
            src_is2=False,
            dst_is2=True,
        )
