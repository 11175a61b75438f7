"""Reader of bags (MCAP, SQLite3, ROS 1) and writer of MCAP bags, without ROS."""

from __future__ import annotations

import os
import shutil
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import IO, Any, cast

import mcap.writer
import yaml
import zstandard
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos

from lidar_perception.data.bag_metadata import (
    METADATA_FILE,
    SENSOR_QOS,
    add_differences,
    complete_profile,
    parse_profiles,
    read_metadata,
)
from lidar_perception.data.mcap_file import NO_INDEX
from lidar_perception.data.open_storage import describe_damage, find_files, open_file
from lidar_perception.data.record_file import RecordFile
from lidar_perception.data.ros1_bag import Ros1File
from lidar_perception.data.storage import END, START, StorageFile, Topic, merge_streams
from lidar_perception.runs.files import check_unused, refuse_other_files, require_name
from lidar_perception.runs.resuming import lock_folder
from lidar_perception.types import InputError, InputWarning
from lidar_perception.wire.codec import decode, encode, load_typestore
from lidar_perception.wire.compression import decompress_message

# Chunks of several clouds compress better and are faster to read; a KITTI cloud has 1.9 MB.
CHUNK_BYTES = 8 * 2**20
MAX_SHOWN = 3  # maximum number of differences between metadata.yaml and the files in a warning
COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}
# mcap always uses level 3 (mcap/writer.py, Writer.__finalize_chunk). For clouds, level 1 takes half
# the time and gives about the same size.
_library: Any = mcap.writer
_library.zstandard = SimpleNamespace(compress=partial(zstandard.compress, level=1))

_Dumper: Any = getattr(yaml, "CSafeDumper", yaml.SafeDumper)  # faster, but optional


class _PlainDumper(_Dumper):
    """YAML dumper that writes no anchors, which other readers of metadata.yaml do not expect."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _to_yaml(content: Any) -> str:
    return yaml.dump(content, Dumper=_PlainDumper, sort_keys=False)


class BagWriter:
    """Writer of a rosbag2 folder with one MCAP file, checksums and metadata.yaml.

    Use it as a context manager. The folder is named NAME.incomplete until it is complete, and only
    one process can write it. After an exception, the incomplete folder remains as a valid bag with
    the messages written so far. Raises InputError if the disk is full.

    Args:
        path: folder of the bag.
        force: replace an existing bag.
        compression: compression of the chunks, a key of COMPRESSIONS.
    """

    def __init__(self, path: str | Path, *, force: bool = False, compression: str = "zstd"):
        self.path, self.force, self.compression = Path(path), force, COMPRESSIONS[compression]
        require_name(self.path)
        self.incomplete_path = self.path.with_name(self.path.name + ".incomplete")
        self.channels: dict[str, int] = {}
        self.topics: dict[str, dict] = {}  # entries of metadata.yaml, by name
        self.times: list[int] = []
        self._check_target()

    def _check_target(self) -> None:
        check_unused(self.path, self.force)
        if self.path.exists():
            if not (self.path / "metadata.yaml").is_file():
                raise InputError(f"{self.path} exists and is not a bag, so it is not overwritten; give another name")
            refuse_other_files(self.path, ("metadata.yaml", "*.mcap*", "*.db3*"))

    def __enter__(self) -> BagWriter:
        with ExitStack() as stack, self._convert_write_errors():
            stack.enter_context(lock_folder(self.incomplete_path))
            self._check_target()  # another process may have written the file in the meantime
            for old in self.incomplete_path.iterdir():
                shutil.rmtree(old) if old.is_dir() and not old.is_symlink() else old.unlink()
            self.file = stack.enter_context(RecordFile(self.incomplete_path / f"{self.path.name}.mcap"))
            stream = cast(IO[bytes], self.file)  # mcap only calls write, tell and flush
            self.mcap = Writer(stream, chunk_size=CHUNK_BYTES, compression=self.compression)
            self.mcap.start(profile="ros2", library="lidar_perception")
            self.open = stack.pop_all()
        return self

    @contextmanager
    def _convert_write_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(
                f"cannot write the bag {self.path}: {error.strerror or error}; the "
                f"messages written so far are in {self.incomplete_path}"
            ) from None

    def add_topic(self, topic: str, type_name: str, qos: dict = SENSOR_QOS) -> None:
        definition, _ = load_typestore().generate_msgdef(type_name, ros_version=2)
        schema = self.mcap.register_schema(type_name, "ros2msg", definition.encode())
        profile = [complete_profile(qos)]
        digest = load_typestore().hash_rihs01(type_name)
        self.channels[topic] = self.mcap.register_channel(
            topic, "cdr", schema, {"offered_qos_profiles": _to_yaml(profile), "topic_type_hash": digest}
        )
        self.topics[topic] = {
            "topic_metadata": {
                "name": topic,
                "type": type_name,
                "serialization_format": "cdr",
                "offered_qos_profiles": profile,
                "type_description_hash": digest,
            },
            "message_count": 0,
        }

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Append a message, given as CDR bytes or as an object made by make_bag_message."""
        channel = self.channels[topic]
        raw = message if isinstance(message, bytes) else encode(message)
        with self._convert_write_errors():
            self.mcap.add_message(channel, stamp_ns, raw, stamp_ns)
        self.topics[topic]["message_count"] += 1
        self.times.append(stamp_ns)

    def __exit__(self, error_type, error, traceback) -> None:
        with self.open, self._convert_write_errors():
            try:
                self._finish()
            except OSError:
                # A bag without an index and without metadata.yaml is still valid.
                self.file.close_with(NO_INDEX)
                (self.incomplete_path / "metadata.yaml").unlink(missing_ok=True)
                if error_type is None:
                    raise
                return  # the exception that ended the context propagates
            if error_type is None:
                if self.path.exists():
                    shutil.rmtree(self.path)
                self.incomplete_path.rename(self.path)

    def _finish(self) -> None:
        start = min(self.times, default=0)
        count = sum(entry["message_count"] for entry in self.topics.values())
        span = {
            "starting_time": {"nanoseconds_since_epoch": start},
            "duration": {"nanoseconds": max(self.times, default=0) - start},
            "message_count": count,
        }
        name = f"{self.path.name}.mcap"
        info = {
            "version": 9,
            "storage_identifier": "mcap",
            "relative_file_paths": [name],
            **span,
            "topics_with_message_count": [*self.topics.values()],
            "compression_format": "",
            "compression_mode": "",
            "files": [{"path": name, **span}],
            "custom_data": None,
            "ros_distro": "jazzy",
        }
        self.mcap.add_metadata("rosbag2", {"serialized_metadata": _to_yaml(info)})
        self.mcap.finish()
        self.file.sync()
        with open(self.incomplete_path / "metadata.yaml", "w") as stream:
            stream.write(_to_yaml({"rosbag2_bagfile_information": info}))
            stream.flush()
            os.fsync(stream.fileno())


class Bag:
    """A bag open for reading. Use it as a context manager.

    A bag is a rosbag2 folder, a folder of ROS 1 bags, or a single storage file. Topics, counts and
    times come from the files; an InputWarning lists differences from metadata.yaml.

    Args:
        warn: False to suppress these warnings.

    Attributes:
        topics: type of each readable topic, by its name.
        counts: number of messages of each readable topic, by its name.
        unreadable: topics in an unsupported encoding, by name.
        start_ns, end_ns: time of the first message, and 1 ns after the last one; 0 without
            messages.

    Raises:
        InputError: the bag is damaged, or the path is not a bag. Checksums and counts are verified;
            damage in a file without checksums may not be detected.
    """

    def __init__(self, path: str | Path, *, warn: bool = True):
        self.path = Path(path)
        self.close: Callable[[], None] = lambda: None
        with ExitStack() as stack:
            metadata = read_metadata(self.path)
            self.files = [(file, open_file(file, stack)) for file in find_files(self.path, metadata)]
            self.topics: dict[str, str] = {}
            self.counts: dict[str, int] = {}
            self.unreadable: dict[str, Topic] = {}
            message_counts, problems = self._collect_topics()
            times = [file.times for _, file in self.files if file.times is not None]
            self.start_ns = min((first for first, _ in times), default=0)
            self.end_ns = max((last + 1 for _, last in times), default=0)
            add_differences(metadata, message_counts, self.start_ns, self.end_ns - self.start_ns - 1)
            self._edited_qos = metadata.qos
            for topic, (type_name, _) in metadata.topics.items():
                if topic not in self.unreadable:
                    self.topics.setdefault(topic, type_name)
                    self.counts.setdefault(topic, 0)
            if metadata.problems:
                more = len(metadata.problems) - MAX_SHOWN
                problems.append(
                    f"{self.path / METADATA_FILE} does not match the bag: {'; '.join(metadata.problems[:MAX_SHOWN])}"
                    f"{f', and {more} more' if more > 0 else ''}. The contents of the storage files are used"
                )
            for problem in problems if warn else ():
                warnings.warn(problem, InputWarning, stacklevel=2)
            self.close = stack.pop_all().close

    def _collect_topics(self) -> tuple[Counter[str], list[str]]:
        """Collect the topics of the files into `topics`, `counts` and `unreadable`.

        Returns:
            The number of messages of every topic, readable or not, and a warning for each topic
            with several types. Only the most frequent type of such a topic is read.
        """
        message_counts, problems = Counter[str](), []
        counts_by_topic: dict[str, Counter[str]] = {}
        for _, file in self.files:
            for topic in file.topics:
                message_counts[topic.name] += topic.messages
                if topic.encoding == "cdr":
                    counts_by_topic.setdefault(topic.name, Counter())[topic.type] += topic.messages
                else:
                    self.unreadable[topic.name] = topic
        for name, counts_by_type in counts_by_topic.items():
            self.unreadable.pop(name, None)
            (self.topics[name], self.counts[name]), *others = counts_by_type.most_common()
            if ignored_types := [f"{count} of {type_name}" for type_name, count in others if count]:
                problems.append(
                    f"{self.path}: {name} has messages of several types; only "
                    f"{self.topics[name]} is read, not {', '.join(ignored_types)}"
                )
        return message_counts, problems

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()

    @property
    def layout(self) -> str:
        """Bag format: "rosbag2 bag" or "ROS 1 bag"."""
        return f"{'ROS 1' if isinstance(self.files[0][1], Ros1File) else 'rosbag2'} bag"

    @property
    def content(self) -> str:
        """Text that lists the topics with their types."""
        others = {name: f"{topic.type} as {topic.encoding}" for name, topic in self.unreadable.items()}
        return (
            ", ".join(f"{topic} ({type_name})" for topic, type_name in sorted({**others, **self.topics}.items()))
            or "nothing"
        )

    def find_qos(self, topic: str) -> list[Qos]:
        """Return the recorded QoS profiles of a topic; [] if unknown.

        Profiles in metadata.yaml take precedence, because people edit it for `ros2 bag play`.
        """
        return parse_profiles(self._edited_qos.get(topic)) or list(
            dict.fromkeys(
                profile
                for _, file in self.files
                for file_topic in file.topics
                if file_topic.name == topic
                for profile in parse_profiles(file_topic.qos)
            )
        )

    def require(self, topic: str) -> None:
        """Raise InputError, which lists the available topics, if the bag lacks a topic."""
        if other := self.unreadable.get(topic):
            raise InputError(
                f"{self.path} has {other.type} as {other.encoding} on {topic}; this "
                "encoding is not supported: record the topic with ROS 2"
            )
        if topic not in self.topics:
            raise InputError(f"{self.path} has no topic {topic}; it has {self.content}")

    def raw_messages(
        self, topics: Iterable[str] | None = None, start_ns: int | None = None, stop_ns: int | None = None
    ) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, time in ns, CDR bytes) in order of time.

        Args:
            topics: names of topics; None: all.
            start_ns, stop_ns: only messages with start_ns <= time < stop_ns.

        Raises:
            InputError: the bag is damaged. A wrong number of messages is detected at the end of a
                file.
        """
        selected_topics = self.topics.keys() & (self.topics if topics is None else {*topics})
        start, stop = START if start_ns is None else start_ns, END if stop_ns is None else stop_ns
        return merge_streams(
            (file.times[0], partial(self._read_file, path, file, selected_topics, start, stop))
            for path, file in self.files
            if file.times and file.times[0] < stop and start <= file.times[1]
        )

    def _read_file(
        self, path: Path, file: StorageFile, selected_topics: set[str], start: int, stop: int
    ) -> Iterator[tuple[str, int, bytes]]:
        name_by_id = {
            topic.id: topic.name
            for topic in file.topics
            if topic.name in selected_topics and topic.encoding == "cdr" and topic.type == self.topics[topic.name]
        }
        if not name_by_id:
            return
        read_counts = Counter[int]()
        try:
            for topic_id, time, data in file.read_messages(name_by_id, start, stop):
                read_counts[topic_id] += 1
                yield name_by_id[topic_id], time, decompress_message(data)
            for topic in file.topics if start <= self.start_ns and stop == END else ():
                if topic.id in name_by_id and topic.messages != read_counts[topic.id]:
                    raise ValueError(
                        f"it declares {topic.messages} messages on {topic.name} and has {read_counts[topic.id]}"
                    )
        except Exception as error:  # zstd, struct, SQLite and rosbags raise their own types
            raise InputError(describe_damage(path, error)) from None

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, time in ns, message of rosbags' class) in order of time."""
        for topic, stamp, data in self.raw_messages(topics):
            try:
                yield topic, stamp, decode(data, self.topics[topic])
            except InputError as error:
                raise InputError(f"{self.path}, topic {topic} at {stamp} ns: {error}") from None


class BagHandle:
    """A bag that stays open, for reading single messages without reading its index again.

    Each process and each thread opens the bag separately, because SQLite requires it, and only the
    first emits warnings. The bag is closed when the thread ends or the handle is deleted.
    """

    def __init__(self, path: Path, warn: bool = True):
        self.path, self.warn, self._local = path, warn, threading.local()

    def __reduce__(self) -> tuple[type[BagHandle], tuple[Path, bool]]:
        return BagHandle, (self.path, False)

    def get_bag(self) -> Bag:
        """Return the bag, opened by the first call in this thread."""
        if getattr(self._local, "process", None) != os.getpid():  # a forked process must not share open files
            self._local.bag, self._local.process = Bag(self.path, warn=self.warn), os.getpid()
            self.warn = False
        bag: Bag = self._local.bag
        return bag
