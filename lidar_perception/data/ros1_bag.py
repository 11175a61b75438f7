"""ROS 1 bags as if ROS 2 had recorded them: the same topics, with the messages of Jazzy as CDR."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, ConnectionExtRosbag2

from lidar_perception.wire.codec import typestore

SUFFIX = ".bag"


def is_ros1(path: Path) -> bool:
    """Whether it is named as a ROS 1 bag is, which is one file; bags of ROS 2 may be folders of
    any name."""
    return path.suffix == SUFFIX and not path.is_dir()


class Ros1Reader:
    """What Bag uses of rosbags' reader of ROS 2 bags. Topics whose type Jazzy does not have are
    left out, as nothing could read them; what a type has gained since is empty."""

    def __init__(self, path: Path):
        self.reader = AnyReader([path])

    def open(self) -> None:
        # Not documented as the rest of rosbags is: if it changes, only these bags are affected.
        from rosbags.convert.converter import LATCH, STATIC_MSGTYPE_RENAMES
        self.reader.open()
        self.recorded = {c.id: c for c in self.reader.connections}
        renamed = {c.id: STATIC_MSGTYPE_RENAMES.get(c.msgtype, c.msgtype)
                   for c in self.reader.connections}
        self.connections = [
            c._replace(msgtype=renamed[c.id], ext=ConnectionExtRosbag2(
                "cdr", LATCH if getattr(c.ext, "latching", 0) else []))
            for c in self.reader.connections if renamed[c.id] in typestore().fielddefs]
        made: dict[str, object] = {}
        self.converted = {c.id: self._conversion(self.recorded[c.id].msgtype, c.msgtype, made)
                          for c in self.connections}

    def close(self) -> None:
        self.reader.close()

    @property
    def start_time(self) -> int:
        return self.reader.start_time

    @property
    def end_time(self) -> int:
        return self.reader.end_time

    def messages(self, connections: Iterable[Connection], start: int | None = None,
                 stop: int | None = None) -> Iterator[tuple[Connection, int, bytes]]:
        """(connection, time, CDR bytes) in order of time."""
        wanted = {c.id: c for c in connections}
        recorded = [self.recorded[number] for number in wanted]
        for connection, time, data in self.reader.messages(recorded, start, stop):
            yield wanted[connection.id], time, bytes(self.converted[connection.id](data))

    def _conversion(self, recorded: str, wanted: str, made: dict[str, object]
                    ) -> Callable[[Any], Any]:
        from rosbags.convert.converter import is_same_wireformat, migrate_bytes
        if is_same_wireformat(self.reader.typestore, typestore(), recorded, wanted):
            return partial(typestore().ros1_to_cdr, typename=wanted)
        return partial(migrate_bytes, self.reader.typestore, typestore(), recorded, wanted, made,
                       src_is2=False, dst_is2=True)
