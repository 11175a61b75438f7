"""Bags: MCAP, SQLite3 and those of ROS 1 in, MCAP out, with or without ROS."""

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
from typing import IO, Any, cast

import yaml
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Qos

from lidar_perception.data.bag_metadata import NAME, compare, read_metadata
from lidar_perception.data.mcap_file import NO_INDEX
from lidar_perception.data.open_storage import damaged, find_files, open_file
from lidar_perception.data.qos import LATCHED_QOS, SENSOR_QOS, full_profile, read_profiles
from lidar_perception.data.record_file import RecordFile
from lidar_perception.data.ros1_bag import Ros1File
from lidar_perception.data.storage import END, START, StorageFile, Topic, in_time_order
from lidar_perception.runs.files import check_free, refuse_others, require_name
from lidar_perception.runs.resuming import locked
from lidar_perception.types import InputError, InputWarning
from lidar_perception.wire.codec import decode, encode, load_typestore
from lidar_perception.wire.compression import decompress_message

__all__ = ["LATCHED_QOS", "SENSOR_QOS", "Bag", "BagWriter", "KeptOpen"]

# A KITTI cloud is 1.9 MB. Chunks that hold several compress better and are read in fewer steps.
CHUNK_BYTES = 8 * 2**20
SHOWN = 3  # differences between metadata.yaml and the files, in a warning

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
        definition, _ = load_typestore().generate_msgdef(type_name, ros_version=2)
        schema = self.mcap.register_schema(type_name, "ros2msg", definition.encode())
        profile = [full_profile(qos)]
        metadata = {"offered_qos_profiles": _yaml(profile),
                    "topic_type_hash": load_typestore().hash_rihs01(type_name)}
        channel = self.mcap.register_channel(topic, "cdr", schema, metadata)
        self.channels[topic] = channel
        self.topics.append({"topic_metadata": {
            "name": topic, "type": type_name, "serialization_format": "cdr",
            "offered_qos_profiles": profile,
            "type_description_hash": load_typestore().hash_rihs01(type_name)}, "message_count": 0})

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


class Bag:
    """A bag open for reading; a context manager.

    A bag is a rosbag2 folder, a folder of ROS 1 bags, or one storage file. Topics, counts and times
    are those of its files; where metadata.yaml says otherwise, an InputWarning says so.

    Args:
        warn: whether to warn; False where another Bag of this path has done so.

    Attributes:
        topics: name -> type, of the topics that can be read.
        counts: name -> number of messages of each of them.
        unreadable: name -> Topic, of topics whose messages nothing here reads.
        start_ns, end_ns: time of the first message, and after the last one; 0 without messages.

    Raises:
        InputError: it is damaged, or no bag. Checksums and counts are compared; damage in a file
            without checksums may pass.
    """

    def __init__(self, path: str | Path, *, warn: bool = True):
        self.path = Path(path)
        self.close: Callable[[], None] = lambda: None
        with ExitStack() as stack:
            metadata = read_metadata(self.path)
            self.files = [(file, open_file(file, stack))
                          for file in find_files(self.path, metadata)]
            self.topics: dict[str, str] = {}
            self.counts: dict[str, int] = {}
            self.unreadable: dict[str, Topic] = {}
            recorded, problems = self._take_topics()
            times = [file.times for _, file in self.files if file.times is not None]
            self.start_ns = min((first for first, _ in times), default=0)
            self.end_ns = max((last + 1 for _, last in times), default=0)
            compare(metadata, recorded, self.start_ns, self.end_ns - self.start_ns - 1)
            self._offered = metadata.qos
            for topic, (kind, _) in metadata.topics.items():
                if topic not in self.unreadable:
                    self.topics.setdefault(topic, kind)
                    self.counts.setdefault(topic, 0)
            if metadata.problems:
                shown, more = metadata.problems[:SHOWN], len(metadata.problems) - SHOWN
                problems.append(f"{self.path / NAME} is wrong: {'; '.join(shown)}"
                                f"{f', and {more} more' if more > 0 else ''}. The bag is read by "
                                "what its files hold")
            for problem in problems if warn else ():
                warnings.warn(problem, InputWarning, stacklevel=2)
            self.close = stack.pop_all().close

    def _take_topics(self) -> tuple[Counter[str], list[str]]:
        """Set topics, counts and unreadable. Return the number of messages by topic, readable or
        not, and a line for each topic with several types, of which the most frequent one counts."""
        recorded, problems = Counter[str](), []
        kinds: dict[str, Counter[str]] = {}
        for _, file in self.files:
            for topic in file.topics:
                recorded[topic.name] += topic.messages
                if topic.encoding == "cdr":
                    kinds.setdefault(topic.name, Counter())[topic.type] += topic.messages
                else:
                    self.unreadable[topic.name] = topic
        for name, found in kinds.items():
            self.unreadable.pop(name, None)
            (self.topics[name], self.counts[name]), *others = found.most_common()
            if left_out := [f"{count} of {kind}" for kind, count in others if count]:
                problems.append(f"{self.path}: {name} has messages of several types; those of "
                                f"{self.topics[name]} are read, not {', '.join(left_out)}")
        return recorded, problems

    def __enter__(self) -> Bag:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()

    @property
    def layout(self) -> str:
        """Kind of the bag: "rosbag2 bag" or "ROS 1 bag"."""
        return f"{'ROS 1' if isinstance(self.files[0][1], Ros1File) else 'rosbag2'} bag"

    @property
    def content(self) -> str:
        """Text that lists the topics with their types."""
        others = {name: f"{topic.type} as {topic.encoding}"
                  for name, topic in self.unreadable.items()}
        return ", ".join(f"{topic} ({kind})" for topic, kind in sorted(
            {**others, **self.topics}.items())) or "nothing"

    def qos(self, topic: str) -> list[Qos]:
        """Return the profiles that the topic was recorded with, as rosbags has them; maybe none.
        Those of metadata.yaml come first, where people edit them for `ros2 bag play`."""
        return read_profiles(self._offered.get(topic)) or list(dict.fromkeys(
            profile for _, file in self.files for each in file.topics if each.name == topic
            for profile in read_profiles(each.qos)))

    def require(self, topic: str) -> None:
        """InputError that lists what there is, if the bag has no such topic."""
        if other := self.unreadable.get(topic):
            raise InputError(f"{self.path} has {other.type} as {other.encoding} on {topic}, which "
                             "is not read; record it with ROS 2")
        if topic not in self.topics:
            raise InputError(f"{self.path} has no topic {topic}; it has {self.content}")

    def raw(self, topics: Iterable[str] | None = None, start_ns: int | None = None,
            stop_ns: int | None = None) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, time, CDR bytes) in order of time; all topics by default. InputError where
        the bag is damaged, at the end of a file that has other numbers of messages than it says."""
        wanted = self.topics.keys() & (self.topics if topics is None else {*topics})
        start, stop = START if start_ns is None else start_ns, END if stop_ns is None else stop_ns
        return in_time_order(
            (file.times[0], partial(self._of_file, path, file, wanted, start, stop))
            for path, file in self.files
            if file.times and file.times[0] < stop and start <= file.times[1])

    def _of_file(self, path: Path, file: StorageFile, wanted: set[str], start: int, stop: int
                 ) -> Iterator[tuple[str, int, bytes]]:
        names = {topic.id: topic.name for topic in file.topics if topic.name in wanted
                 and topic.encoding == "cdr" and topic.type == self.topics[topic.name]}
        if not names:
            return
        found = Counter[int]()
        try:
            for topic, time, data in file.messages(names, start, stop):
                found[topic] += 1
                yield names[topic], time, decompress_message(data)
            for said in file.topics if start <= self.start_ns and stop == END else ():
                if said.id in names and said.messages != found[said.id]:
                    raise ValueError(f"it says {said.messages} messages on {said.name} and holds "
                                     f"{found[said.id]}")
        except Exception as error:  # zstd, struct, SQLite and rosbags raise their own
            raise InputError(damaged(path, error)) from None

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Yield (topic, time, message of rosbags' class) in order of time."""
        for topic, stamp, data in self.raw(topics):
            try:
                yield topic, stamp, decode(data, self.topics[topic])
            except InputError as error:
                raise InputError(f"{self.path}, topic {topic} at {stamp} ns: {error}") from None


class KeptOpen:
    """A bag that stays open for whoever reads single messages of it: to open one takes as long as
    its index, which grows with the bag. Each process and each thread has its own, as SQLite wants
    it; they are closed with their thread, or when nobody has this any more. The first one warns."""

    def __init__(self, path: Path, warn: bool = True):
        self.path, self.warn, self.here = path, warn, threading.local()

    def __reduce__(self) -> tuple[type[KeptOpen], tuple[Path, bool]]:
        return KeptOpen, (self.path, False)

    def bag(self) -> Bag:
        """The bag, opened by the first call of this thread."""
        if getattr(self.here, "process", None) != os.getpid():  # a fork shares what was open
            self.here.bag, self.here.process = Bag(self.path, warn=self.warn), os.getpid()
            self.warn = False
        bag: Bag = self.here.bag
        return bag
