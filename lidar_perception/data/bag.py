"""Bags: MCAP, SQLite3 and those of ROS 1 in, MCAP out, with or without ROS."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, cast

import yaml
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Connection, ConnectionExtRosbag2
from rosbags.rosbag2 import Reader

from lidar_perception.data.mcap_index import NO_INDEX, check_index, profile_of
from lidar_perception.data.record_file import RecordFile
from lidar_perception.data.ros1_bag import Ros1Reader, is_ros1
from lidar_perception.data.unchunked import Unchunked
from lidar_perception.runs.files import check_free, refuse_others, regular, require_name, short
from lidar_perception.runs.resuming import locked
from lidar_perception.types import InputError
from lidar_perception.wire.codec import decode, encode, typestore

# A KITTI cloud is 1.9 MB. Chunks that hold several compress better and are read in fewer steps.
CHUNK_BYTES = 8 * 2**20

# Quality of service as rosbag2 names it. Latched topics reach whoever subscribes later.
SENSOR_QOS = dict(history="keep_last", depth=10, reliability="reliable", durability="volatile")
LATCHED_QOS = dict(history="keep_last", depth=1, reliability="reliable",
                   durability="transient_local")


_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # faster, where it was built


class _Plain(_Dumper):
    """YAML without anchors, as other readers of metadata.yaml expect it."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _yaml(content: Any) -> str:
    return yaml.dump(content, Dumper=_Plain, sort_keys=False)


class BagWriter:
    """Writes a rosbag2 folder with one MCAP file: zstd chunks, checksums, metadata.yaml.

    A context manager, of one process at a time. The folder appears under its name once it is
    complete; after an exception what was written so far is closed properly and left as
    NAME.incomplete. InputError where the disk is full: NAME.incomplete then holds the messages that
    found room.
    """

    def __init__(self, path: str | Path, *, force: bool = False):
        self.path, self.force = Path(path), force
        require_name(self.path)
        self.partial = self.path.with_name(self.path.name + ".incomplete")
        self.channels: dict[str, int] = {}
        self.topics: list[dict] = []
        self.times: list[int] = []
        self._may_write()

    def _may_write(self) -> None:
        check_free(self.path, self.force)
        if self.path.exists():
            if not (self.path / "metadata.yaml").is_file():
                raise InputError(f"{self.path} is no bag, so it is not replaced; give another name")
            refuse_others(self.path, ("metadata.yaml", "*.mcap*", "*.db3*"))

    def __enter__(self) -> BagWriter:
        with ExitStack() as stack, self._named():
            stack.enter_context(locked(self.partial))
            self._may_write()  # another process may just have written it
            for old in self.partial.iterdir():
                shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()
            self.file = stack.enter_context(RecordFile(self.partial / f"{self.path.name}.mcap"))
            stream = cast(IO[bytes], self.file)  # mcap only writes, tells and flushes
            self.mcap = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self.mcap.start(profile="ros2", library="lidar_perception")
            self.open = stack.pop_all()
        return self

    @contextmanager
    def _named(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(f"cannot write the bag {self.path}: {error.strerror or error}; what "
                             f"could be written is in {self.partial}") from None

    def add_topic(self, topic: str, type_name: str, qos: dict = SENSOR_QOS) -> None:
        definition, _ = typestore().generate_msgdef(type_name, ros_version=2)
        schema = self.mcap.register_schema(type_name, "ros2msg", definition.encode())
        profile = [_full_qos(qos)]
        metadata = {"offered_qos_profiles": _yaml(profile),
                    "topic_type_hash": typestore().hash_rihs01(type_name)}
        channel = self.mcap.register_channel(topic, "cdr", schema, metadata)
        self.channels[topic] = channel
        self.topics.append({"topic_metadata": {
            "name": topic, "type": type_name, "serialization_format": "cdr",
            "offered_qos_profiles": profile,
            "type_description_hash": typestore().hash_rihs01(type_name)}, "message_count": 0})

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Append a message: an object of bag_message, or CDR bytes as they are."""
        channel = self.channels[topic]
        raw = message if isinstance(message, bytes) else encode(message)
        with self._named():
            self.mcap.add_message(channel, stamp_ns, raw, stamp_ns)
        self.topics[list(self.channels).index(topic)]["message_count"] += 1
        self.times.append(stamp_ns)

    def __exit__(self, kind, error, trace) -> None:
        with self.open, self._named():
            try:
                self._finish()
            except OSError:
                # As mcap has it, a file may end without an index; so may a bag without metadata.
                self.file.close_with(NO_INDEX)
                (self.partial / "metadata.yaml").unlink(missing_ok=True)
                if kind is None:
                    raise
                return  # the error that there is says why
            if kind is None:
                if self.path.exists():
                    shutil.rmtree(self.path)
                self.partial.rename(self.path)

    def _finish(self) -> None:
        start = min(self.times, default=0)
        count = sum(t["message_count"] for t in self.topics)
        span = {"starting_time": {"nanoseconds_since_epoch": start},
                "duration": {"nanoseconds": max(self.times, default=0) - start},
                "message_count": count}
        name = f"{self.path.name}.mcap"
        info = {"version": 9, "storage_identifier": "mcap", "relative_file_paths": [name], **span,
                "topics_with_message_count": self.topics, "compression_format": "",
                "compression_mode": "", "files": [{"path": name, **span}], "custom_data": None,
                "ros_distro": "jazzy"}
        self.mcap.add_metadata("rosbag2", {"serialized_metadata": _yaml(info)})
        self.mcap.finish()
        self.file.sync()
        with open(self.partial / "metadata.yaml", "w") as stream:
            stream.write(_yaml({"rosbag2_bagfile_information": info}))
            stream.flush()
            os.fsync(stream.fileno())


def _full_qos(qos: dict) -> dict:
    forever = {"sec": 9223372036, "nsec": 854775807}
    return {**qos, "deadline": forever, "lifespan": forever, "liveliness": "automatic",
            "liveliness_lease_duration": forever, "avoid_ros_namespace_conventions": False}


class Bag:
    """A bag open for reading; a context manager. topics maps name to type, counts to the number of
    messages. InputError where it is damaged: checksums and counts are compared, so that what is
    read is what was written, in as far as the writer left checksums."""

    def __init__(self, path: str | Path):
        self.path = Path(path)
        source = _storage(self.path)
        try:
            self.reader: Reader | Ros1Reader = (
                Ros1Reader(source) if is_ros1(source) else Reader(source))
            self.reader.open()
        except Exception as error:  # rosbags lets through what damaged sizes lead to
            raise InputError(_foreign(source) or _unreadable(source, error)) from None
        try:
            for part in _mcap_parts(self.reader):
                if check_index(part.path) == 0:
                    part.messages = Unchunked(part).messages
            # They are read one after the other as metadata.yaml names them, in whatever order.
            _parts(self.reader).sort(key=lambda part: part.metadata.start_time)
            self.connections = list(self.reader.connections)
            _check(self.reader, self.connections)
            self.topics = {c.topic: c.msgtype for c in self.connections}
            self.counts = dict.fromkeys(self.topics, 0)
            for connection in self.connections:
                self.counts[connection.topic] += connection.msgcount
        except Exception as error:
            self.reader.close()
            raise InputError(_unreadable(source, error)) from None

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: Any) -> None:
        self.reader.close()

    @property
    def start_ns(self) -> int:
        return self.reader.start_time

    @property
    def end_ns(self) -> int:
        return self.reader.end_time

    @property
    def content(self) -> str:
        """Its topics, each with its type, for people."""
        return ", ".join(f"{topic} ({kind})"
                         for topic, kind in sorted(self.topics.items())) or "nothing"

    def qos(self, topic: str) -> list:
        """The profiles the topic was recorded with, as rosbags has them; maybe none."""
        return next(offered_qos(c) for c in self.connections if c.topic == topic)

    def require(self, topic: str) -> None:
        """InputError that lists what there is, if the bag has no such topic."""
        if topic not in self.topics:
            raise InputError(f"{self.path} has no topic {topic}; it has {self.content}")

    def raw(self, topics: Iterable[str] | None = None, start_ns: int | None = None,
            stop_ns: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """(topic, time, CDR bytes) in order of time; all topics by default. InputError where the
        bag is damaged, at the end if other numbers of messages were read than it says."""
        wanted = [c for c in self.connections if topics is None or c.topic in topics]
        if not wanted:
            return
        found = dict.fromkeys((c.topic for c in wanted), 0)
        try:
            for connection, stamp, data in self.reader.messages(wanted, start_ns, stop_ns):
                found[connection.topic] += 1
                yield connection.topic, stamp, data
        except Exception as error:  # rosbags lets through what zstd, struct and SQLite raise
            raise InputError(_unreadable(self.path, error)) from None
        if (start_ns is None or start_ns <= self.start_ns) and stop_ns is None:
            for topic, count in found.items():
                if count != self.counts[topic]:
                    raise InputError(_unreadable(self.path, ValueError(
                        f"it says {self.counts[topic]} messages on {topic} and holds {count}")))

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """(topic, time, message) of rosbags' classes."""
        for topic, stamp, data in self.raw(topics):
            try:
                yield topic, stamp, decode(data, self.topics[topic])
            except InputError as error:
                raise InputError(f"{self.path}, topic {topic} at {stamp} ns: {error}") from None


class KeptOpen:
    """A bag that stays open for whoever reads single messages of it: to open one takes as long as
    its index, which grows with the bag. Each process and each thread has its own, as SQLite wants
    it; they are closed with their thread, or when nobody has this any more."""

    def __init__(self, path: Path):
        self.path, self.here = path, threading.local()

    def __reduce__(self) -> tuple[type[KeptOpen], tuple[Path]]:
        return KeptOpen, (self.path,)

    def bag(self) -> Bag:
        if getattr(self.here, "process", None) != os.getpid():  # a fork shares what was open
            self.here.bag, self.here.process = Bag(self.path), os.getpid()
        bag: Bag = self.here.bag
        return bag


def _check(reader: Reader | Ros1Reader, connections: list[Connection]) -> None:
    """ValueError where metadata.yaml, which may say anything, has no names, numbers or times."""
    for connection in connections:
        topic, kind, count = connection.topic, connection.msgtype, connection.msgcount
        if not isinstance(topic, str) or not isinstance(kind, str):
            raise ValueError(f"it names a topic {topic!r} of type {kind!r}")
        if not isinstance(count, int) or count < 0:
            raise ValueError(f"it says {count!r} messages on {topic}")
    for time in reader.start_time, reader.end_time:
        if not isinstance(time, int) or abs(time) > 2**63:
            raise ValueError(f"it has {time!r} for a time in nanoseconds")


def _parts(reader: Reader | Ros1Reader) -> list[Any]:
    """rosbags' readers of the files of a bag of ROS 2."""
    storage = getattr(reader, "storage", None)
    parts: list[Any] = getattr(storage, "storages", [storage] if storage else [])
    return parts


def _mcap_parts(reader: Reader | Ros1Reader) -> list[Any]:
    return [part for part in _parts(reader) if part.path.suffix == ".mcap"]


def offered_qos(connection: Connection) -> list:
    """The profiles of a topic of a rosbag2 bag, as rosbags has them; maybe none."""
    return cast(ConnectionExtRosbag2, connection.ext).offered_qos_profiles


def _storage(path: Path) -> Path:
    """The folder, or the one storage file in a folder without metadata.yaml."""
    if not path.exists():
        raise InputError(f"there is no bag {path}")
    for file in path.iterdir() if path.is_dir() else [path]:
        regular(file)
    if path.is_dir() and not (path / "metadata.yaml").exists():
        files = [*path.glob("*.mcap"), *path.glob("*.db3")]
        if len(files) != 1:
            raise InputError(f"{path} has no metadata.yaml and {len(files)} storage files, so it "
                             "is no rosbag2 bag; run 'ros2 bag reindex' or give one .mcap file")
        return files[0]
    if path.is_file() and path.suffix not in (".mcap", ".db3") and not is_ros1(path):
        raise InputError(f"{path} is no bag; give the folder of a rosbag2 bag, an .mcap, a .db3 or "
                         "a ROS 1 .bag file")
    return path


def _foreign(source: Path) -> str:
    """What to do with an MCAP file whose messages are not those of ROS 2; "" where it is none."""
    profile = profile_of(source) if source.is_file() and source.suffix == ".mcap" else None
    if profile in (None, "ros2"):
        return ""
    if profile == "ros1":
        return f"{source} has messages of ROS 1 in MCAP; give the .bag that it was made of"
    return (f"{source} is MCAP but no bag of ROS 2 (profile {profile!r}), as Foxglove and others "
            "write it; give clouds as sensor_msgs/PointCloud2 in a bag of ROS 2")


def _unreadable(path: Path, error: Exception) -> str:
    reason = short(error).rstrip(".")
    remedy = "rosbag reindex" if is_ros1(path) else "mcap recover"
    return f"the bag {path} is truncated or damaged ({reason}); '{remedy}' may save what it holds"
