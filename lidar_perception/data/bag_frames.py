"""Clouds of a bag as frames, with the labels, camera and poses on its other topics."""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cached_property, partial
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.camera import Calibration
from lidar_perception.data.bag import Bag, BagHandle
from lidar_perception.data.bag_metadata import METADATA_FILE
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.data.cloud_files import is_cloud
from lidar_perception.data.frame import BOXES, CAMERA, POINT_LABELS, POSES, Frame, PointTruth, Recording
from lidar_perception.data.open_storage import list_storage_files
from lidar_perception.data.recorded_scale import MAX_READ, infer_scale
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError, PointCloud
from lidar_perception.wire.clouds import CLOUD_TYPES, check_readable, decode_cloud, diagnose_packets, find_cloud_topics
from lidar_perception.wire.messages import read_calibration, read_column, read_raw_intensity, to_point_cloud, to_truth
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, INSTANCE, POINTS, SEMANTIC, TRUTH
from msg_utils.markers import from_marker_array
from msg_utils.stamps import SECOND_NS

# Topics that a bag must have for each kind of content.
TOPICS_BY_CONTENT = {BOXES: {TRUTH}, CAMERA: {CAMERA_INFO, EXTRINSICS}}


def can_open(path: Path) -> bool:
    """Return True for a bag file, or a folder with one."""
    if path.is_file():
        return not is_cloud(path)  # other single files are not supported
    return (path / METADATA_FILE).is_file() or bool(list_storage_files(path))


def choose_cloud_topic(bag: Bag, points: str = "", example: str = "{bag}:{topic}") -> str:
    """Choose the topic of the clouds: `points` if given, otherwise /points, otherwise the only one.

    Raises InputError if the bag has no such topic, or if the choice is ambiguous; the message shows
    how to choose a topic, as in `example`.
    """
    cloud_topics = find_cloud_topics(bag.topics)
    recorded_topics = [topic for topic in cloud_topics if bag.counts[topic]]
    if not points and POINTS not in recorded_topics and len(recorded_topics) > 1:
        raise InputError(
            f"{bag.path} has clouds on {', '.join(recorded_topics)}; choose a topic, as in "
            + example.format(bag=bag.path, topic=recorded_topics[0])
        )
    if not points and not cloud_topics:
        others = {name: topic.type for name, topic in bag.unreadable.items()} | bag.topics
        raise InputError(
            f"{bag.path} has no sensor_msgs/PointCloud2 and no other clouds: "
            + (diagnose_packets(others) or f"it has {bag.content}. Record the cloud topic of the sensor's driver")
        )
    topic = points or (recorded_topics[0] if recorded_topics and POINTS not in recorded_topics else POINTS)
    bag.require(topic)
    if bag.topics[topic] not in CLOUD_TYPES:
        raise InputError(
            f"{bag.path} has {bag.topics[topic]} on {topic} instead of clouds; "
            + (
                diagnose_packets({topic: bag.topics[topic]})
                or f"choose another topic, as in {example.format(bag=bag.path, topic=POINTS)}"
            )
        )
    return topic


def open_layout(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Open the clouds on a topic of a bag, see choose_cloud_topic."""
    handle = BagHandle(path)
    bag = handle.get_bag()
    points = choose_cloud_topic(bag, points)
    topics = {topic for topic, count in bag.counts.items() if count}
    frames = BagFrames(handle, points, bag.topics[points], bag.counts[points])
    has_point_labels = False
    frames.check_readable()
    with suppress(InputError):  # a damaged cloud is reported when it is read
        has_point_labels = (
            frames.first_message is not None and frames.decode_labelled_cloud(frames.first_message[1]) is not None
        )
    contents = frozenset(
        content for content, required_topics in TOPICS_BY_CONTENT.items() if required_topics <= topics
    ) | {*[POINT_LABELS] * has_point_labels, *[POSES] * frames.poses.has_poses}
    return Recording(
        path, f"{bag.layout}, clouds on {points}", frames, contents, has_sensor_height=False, has_times=True
    )


class BagFrames(Sequence):
    """The frames of a bag in order of time; native() of a frame returns its message.

    Iteration reads the bag once, and each frame holds its cloud. A frame that is accessed by index,
    except the first one, reads its cloud when needed; the first such access reads the times of all
    clouds.
    """

    def __init__(
        self, handle: BagHandle, points: str, message_type: str, count: int, sensor_height: float = SENSOR_HEIGHT
    ):
        self.handle, self.points, self.message_type, self.cloud_count = handle, points, message_type, count
        self.path, self.sensor_height = handle.path, sensor_height

    def with_sensor_height(self, sensor_height: float) -> BagFrames:
        """Return the frames with another sensor height above the ground, in metres."""
        return BagFrames(self.handle, self.points, self.message_type, self.cloud_count, sensor_height)

    def check_readable(self) -> None:
        """Raise InputError if the compression of the clouds is not supported."""
        if self.first_message is not None:
            with self._add_error_context(self.first_message[0]):
                check_readable(self.first_message[1], self.message_type)

    def __len__(self) -> int:
        return self.cloud_count

    def __iter__(self) -> Iterator[Frame]:
        stamp_counts: Counter[int] = Counter()
        with Bag(self.path, warn=False) as bag:
            for i, (_, time, data) in enumerate(bag.raw_messages({self.points})):
                stamp = self._find_stamp(data, time)
                stamp_counts[stamp] += 1
                yield self._make_frame(i, time, stamp, stamp_counts[stamp], partial(bytes, data))

    def read_stamps(self) -> np.ndarray:
        """Return the stamps (count,) int64 ns of all clouds; the first call reads the entire bag."""
        return np.array([row[2] for row in self._index], np.int64)

    def read_message(self, i: int) -> Any:
        """Return cloud i as a PointCloud2 with all recorded columns."""
        time, earlier_count, *_ = self._index[i]
        return decode_cloud(self._read(time, earlier_count), self.message_type)

    def __getitem__(self, i):
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(self.cloud_count))]
        if not -self.cloud_count <= i < self.cloud_count:
            raise IndexError(i)
        i %= self.cloud_count
        if i == 0 and self.first_message is not None:
            time, data = self.first_message
            return self._make_frame(0, time, self._find_stamp(data, time), 1, lambda: data)
        time, earlier_count, stamp, occurrence = self._index[i]
        return self._make_frame(i, time, stamp, occurrence, partial(self._read, time, earlier_count))

    @cached_property
    def _index(self) -> list[tuple[int, int, int, int]]:
        """Row for each cloud: log time, number of earlier clouds with this time, stamp, and number of
        clouds with this stamp so far."""
        time_counts: Counter[int] = Counter()
        stamp_counts: Counter[int] = Counter()
        rows = []
        for _, time, data in self.handle.get_bag().raw_messages({self.points}):
            stamp = self._find_stamp(data, time)
            stamp_counts[stamp] += 1
            rows.append((time, time_counts[time], stamp, stamp_counts[stamp]))
            time_counts[time] += 1
        return rows

    def _read(self, time: int, earlier_count: int) -> bytes:
        messages = self.handle.get_bag().raw_messages({self.points}, time, time + 1)
        return next(islice(messages, earlier_count, None))[2]

    @cached_property
    def _annotations(self) -> tuple[dict[int, GroundTruth], list, list]:
        """Labels by stamp, and (time, message) of each calibration and transform in the bag.

        All are read at once, because they may come after their cloud.
        """
        truth: dict[int, GroundTruth] = {}
        infos: list[tuple[int, Any]] = []
        transforms: list[tuple[int, Any]] = []
        bag = self.handle.get_bag()
        for topic, time, msg in bag.messages({TRUTH, CAMERA_INFO, EXTRINSICS} & {*bag.topics}):
            if topic == TRUTH:
                objects = from_marker_array(msg)
                truth[objects.stamp_ns or time] = to_truth(objects)
                if not objects.stamp_ns:  # stamp missing, or at the start of simulated time
                    truth.setdefault(0, truth[time])
            else:
                (infos if topic == CAMERA_INFO else transforms).append((time, msg))
        return truth, infos, transforms

    @cached_property
    def files(self) -> tuple[Path, ...]:
        """Storage files of the bag."""
        if self.path.is_file():
            return (self.path,)
        return tuple(sorted(file for file in self.path.iterdir() if file.is_file() and file.suffix != ".yaml"))

    @cached_property
    def first_message(self) -> tuple[int, bytes] | None:
        """Time and serialized message of the first cloud; None without clouds."""
        raw = self.handle.get_bag().raw_messages({self.points})
        return next(((time, bytes(data)) for _, time, data in raw), None)

    def _find_stamp(self, data: bytes, time: int) -> int:
        """Return header.stamp of a serialized cloud in ns.

        The log time is used if all clouds lack a stamp, or if the message is too short.
        """
        if (stamp := _read_header_stamp(data)) == 0 and self._has_no_stamps:
            stamp = None
        return time if stamp is None else stamp

    @cached_property
    def _has_no_stamps(self) -> bool:
        """True if all stamps are 0; at the start of simulated time only a few are."""
        messages = self.handle.get_bag().raw_messages({self.points})
        return not any(_read_header_stamp(data) for *_, data in messages)

    @cached_property
    def full_scale(self) -> float:
        """Intensity of a full reflection, the same for all frames.

        It is inferred from the first clouds, because reading others would take too long.
        """
        return infer_scale(
            self._read_first_clouds(), lambda data: read_raw_intensity(decode_cloud(data, self.message_type))
        )

    def _read_first_clouds(self) -> Iterator[bytes]:
        with suppress(InputError):  # reported when the frame is read
            for _, _, data in islice(self.handle.get_bag().raw_messages({self.points}), MAX_READ):
                yield bytes(data)

    @cached_property
    def poses(self) -> BagPoses:
        """Poses of the frame_id of the first cloud."""
        return BagPoses(self.handle, _read_frame_id(self.first_message[1]) if self.first_message else "")

    def _make_frame(self, i: int, time: int, stamp: int, occurrence: int, data: Callable[[], bytes]) -> Frame:
        name = str(stamp) if occurrence == 1 else f"{stamp}-{occurrence}"  # clouds may have equal stamps
        return Frame(
            name,
            stamp,
            partial(self._load, time, data),
            partial(self._read_truth, stamp),
            point_truth=partial(self._read_point_truth, time, data),
            calibration=partial(self._read_calibration, time),
            pose=lambda: self.poses(stamp),
            index=i,
            sensor_height=self.sensor_height,
            files=self.files,
            native=lambda: decode_cloud(data(), self.message_type),
            intensity_max=lambda: self.full_scale,
        )

    def _load(self, time: int, data: Callable[[], bytes]) -> PointCloud:
        with self._add_error_context(time):
            return to_point_cloud(decode_cloud(data(), self.message_type), self.full_scale)[0]

    @contextmanager
    def _add_error_context(self, time: int) -> Iterator[None]:
        """Add the cloud's topic and time to an InputError."""
        try:
            yield
        except InputError as error:
            raise InputError(f"{self.path}, topic {self.points} at {time} ns: {error}") from None

    def decode_labelled_cloud(self, data: bytes) -> Any:
        """Decode a serialized cloud with point labels; None if it has none or is malformed."""
        with suppress(InputError):
            msg = decode_cloud(data, self.message_type)
            if {SEMANTIC, INSTANCE} <= {f.name for f in msg.fields}:
                return msg
        return None

    def _read_point_truth(self, time: int, data: Callable[[], bytes]) -> PointTruth | None:
        if (msg := self.decode_labelled_cloud(data())) is None:
            return None
        with self._add_error_context(time):
            indices = to_point_cloud(msg)[1]
            classes, instances = (read_column(msg, name, indices) for name in (SEMANTIC, INSTANCE))
        assert classes is not None and instances is not None  # see decode_labelled_cloud
        return PointTruth(classes.astype(np.uint16), instances.astype(np.uint16))

    def _read_truth(self, stamp: int) -> GroundTruth | None:
        return self._annotations[0].get(stamp)

    def _read_calibration(self, time: int) -> Calibration | None:
        _, infos, transforms = self._annotations
        info, transform = _find_latest(infos, time), _find_latest(transforms, time)
        return read_calibration(info, transform) if info and transform else None


def _read_header_stamp(data: bytes) -> int | None:
    """Return header.stamp of a serialized message in ns; None if the message is too short."""
    if len(data) < 12:
        return None
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds * SECOND_NS + nanoseconds)


def _read_frame_id(data: bytes) -> str:
    """Return header.frame_id of a serialized message; "" if the message is too short."""
    if len(data) < 16:
        return ""
    (size,) = struct.unpack_from("<I" if data[1] & 1 else ">I", data, 12)
    return bytes(data[16 : 16 + size]).rstrip(b"\0").decode(errors="replace")


def _find_latest(messages: list, time: int) -> Any:
    """Return the last message up to a time; the first message if all are later."""
    next_index = bisect_right(messages, time, key=itemgetter(0))
    return messages[max(next_index - 1, 0)][1] if messages else None
