"""ROS 1 bags as if ROS 2 had recorded them: the same topics, with the messages of Jazzy as CDR."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader

from lidar_perception.data.qos import LATCHED_QOS
from lidar_perception.data.storage import Stream, Topic
from lidar_perception.wire.clouds import LIVOX
from lidar_perception.wire.codec import load_typestore
from lidar_perception.wire.livox import livox_ros1_to_cdr

MAGIC = b"#ROSBAG V"
SUFFIX = ".bag"


class Ros1File:
    """A .bag file open for reading, see StorageFile. Types that Jazzy does not have keep the
    encoding ros1, as nothing here could read them; what a type has gained since is empty."""

    def __init__(self, path: Path):
        # Not documented as the rest of rosbags is: if it changes, only these bags are affected.
        from rosbags.convert.converter import STATIC_MSGTYPE_RENAMES
        self.reader = AnyReader([path])
        self.reader.open()
        self.recorded = {c.id: c for c in self.reader.connections}
        self.topics = []
        for c in self.reader.connections:
            kind = STATIC_MSGTYPE_RENAMES.get(c.msgtype, c.msgtype)
            self.topics.append(Topic(
                c.id, c.topic, kind, "cdr" if kind in load_typestore().fielddefs else "ros1",
                [LATCHED_QOS] if getattr(c.ext, "latching", 0) else [], c.msgcount))
        made: dict[str, object] = {}
        self.converted = {topic.id: self._conversion(self.recorded[topic.id].msgtype, topic.type,
                                                     made)
                          for topic in self.topics if topic.encoding == "cdr"}
        for topic in self.topics:
            if topic.type in LIVOX:  # rosbags converts point by point
                self.converted[topic.id] = livox_ros1_to_cdr
        self.times = ((self.reader.start_time, self.reader.end_time - 1)
                      if self.reader.message_count else None)

    def close(self) -> None:
        """Close the file."""
        self.reader.close()

    def messages(self, ids: Collection[int], start: int, stop: int) -> Stream:
        """Yield (topic id, time, CDR bytes) of topics, start <= time < stop, in order of time."""
        connections = [self.recorded[number] for number in ids]
        for connection, time, data in self.reader.messages(connections, start, stop):
            yield connection.id, time, bytes(self.converted[connection.id](data))

    def _conversion(self, recorded: str, wanted: str, made: dict[str, object]
                    ) -> Callable[[Any], Any]:
        from rosbags.convert.converter import is_same_wireformat, migrate_bytes
        if is_same_wireformat(self.reader.typestore, load_typestore(), recorded, wanted):
            return partial(load_typestore().ros1_to_cdr, typename=wanted)
        return partial(migrate_bytes, self.reader.typestore, load_typestore(), recorded, wanted,
                       made, src_is2=False, dst_is2=True)
