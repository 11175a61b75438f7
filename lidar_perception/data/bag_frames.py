"""The clouds of a bag as labelled frames, with the labels and the camera that lie beside them."""

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
from lidar_perception.data.bag import Bag, KeptOpen
from lidar_perception.data.bag_metadata import NAME
from lidar_perception.data.bag_poses import BagPoses
from lidar_perception.data.cloud_files import is_cloud
from lidar_perception.data.frame import (
    BOXES,
    CAMERA,
    POINT_LABELS,
    POSES,
    Frame,
    PointTruth,
    Recording,
)
from lidar_perception.data.open_storage import storage_files
from lidar_perception.data.recorded_scale import MAX_READ, scale_of
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError, LidarFrame
from lidar_perception.wire.clouds import (
    CLOUD_TYPES,
    check_readable,
    decode_cloud,
    diagnose_packets,
    find_cloud_topics,
)
from lidar_perception.wire.messages import (
    read_calibration,
    read_column,
    read_raw_intensity,
    to_frame,
    to_truth,
)
from lidar_perception.wire.topics import CAMERA_INFO, EXTRINSICS, INSTANCE, POINTS, SEMANTIC, TRUTH
from msg_utils.markers import from_marker_array
from msg_utils.stamps import SECOND

# What is known by these topics
BESIDE = {BOXES: {TRUTH}, CAMERA: {CAMERA_INFO, EXTRINSICS}}


def recognises(path: Path) -> bool:
    """Whether a bag lies there: a file, or a folder with one."""
    if path.is_file():
        return not is_cloud(path)  # nothing else is one file
    return (path / NAME).is_file() or bool(storage_files(path))


def cloud_topic(bag: Bag, points: str = "") -> str:
    """The topic of a bag to take the clouds from: points, where one is named, else /points, else
    the only one with clouds. InputError where there is none, or several."""
    every = find_cloud_topics(bag.topics)
    clouds = [topic for topic in every if bag.counts[topic]]
    if not points and POINTS not in clouds and len(clouds) > 1:
        raise InputError(f"{bag.path} has clouds on {', '.join(clouds)}; name the topic of one, as "
                         f"in {bag.path}:{clouds[0]}")
    if not points and not every:
        others = {name: topic.type for name, topic in bag.unreadable.items()} | bag.topics
        raise InputError(f"{bag.path} has no sensor_msgs/PointCloud2 and no other clouds: "
                         + (diagnose_packets(others) or f"it has {bag.content}. Record the cloud "
                            "topic of the sensor's driver"))
    chosen = points or (clouds[0] if clouds and POINTS not in clouds else POINTS)
    bag.require(chosen)
    if bag.topics[chosen] not in CLOUD_TYPES:
        raise InputError(f"{bag.path} has {bag.topics[chosen]} on {chosen}, no clouds; "
                         + (diagnose_packets({chosen: bag.topics[chosen]})
                            or f"name another topic, as in {bag.path}:/points"))
    return chosen


def open_recording(path: Path, *, points: str = "", scans: bool = True) -> Recording:
    """Frames of the clouds on a topic, see cloud_topic."""
    opened = KeptOpen(path)
    bag = opened.bag()
    points = cloud_topic(bag, points)
    topics = {topic for topic, count in bag.counts.items() if count}
    frames = BagFrames(opened, points, bag.topics[points], bag.counts[points])
    labelled = False
    frames.check_readable()
    with suppress(InputError):  # a damaged cloud is named when it is read
        labelled = frames.first is not None and frames.labelled(frames.first[1]) is not None
    has = frozenset(what for what, needed in BESIDE.items() if needed <= topics) | {
        *[POINT_LABELS] * labelled, *[POSES] * frames.poses.known}
    return Recording(path, f"{bag.layout}, clouds on {points}", frames, has, mounted=False,
                     timed=True)


class BagFrames(Sequence):
    """The frames in order of time; native() of each gives its message. Iterating reads the bag
    once, and each frame holds its cloud. So does the first one by its number; another one by its
    number reads it when it is asked for, found by its time after one look through the bag for the
    times of all."""

    def __init__(self, opened: KeptOpen, points: str, kind: str, count: int,
                 sensor_height: float = SENSOR_HEIGHT):
        self.opened, self.points, self.kind, self.clouds = opened, points, kind, count
        self.path, self.sensor_height = opened.path, sensor_height

    def mounted_at(self, sensor_height: float) -> BagFrames:
        """The frames of a sensor at that height."""
        return BagFrames(self.opened, self.points, self.kind, self.clouds, sensor_height)

    def check_readable(self) -> None:
        """Raise InputError if the clouds are compressed in a way that is not read."""
        if self.first is not None:
            with self._named(self.first[0]):
                check_readable(self.first[1], self.kind)

    def __len__(self) -> int:
        return self.clouds

    def __iter__(self) -> Iterator[Frame]:
        names: Counter[int] = Counter()
        with Bag(self.path, warn=False) as bag:
            for i, (_, time, data) in enumerate(bag.raw({self.points})):
                stamp = self._stamp(data, time)
                names[stamp] += 1
                yield self._frame(i, time, stamp, names[stamp], partial(bytes, data))

    def stamps(self) -> np.ndarray:
        """(count,) int64 ns: the stamps of all clouds, after one look through the bag."""
        return np.array([row[2] for row in self._index], np.int64)

    def message(self, i: int) -> Any:
        """Cloud i as a PointCloud2 with all the columns that were recorded."""
        time, before, *_ = self._index[i]
        return decode_cloud(self._read(time, before), self.kind)

    def __getitem__(self, i):
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(self.clouds))]
        if not -self.clouds <= i < self.clouds:
            raise IndexError(i)
        i %= self.clouds
        if i == 0 and self.first is not None:
            time, data = self.first
            return self._frame(0, time, self._stamp(data, time), 1, lambda: data)
        time, before, stamp, which = self._index[i]
        return self._frame(i, time, stamp, which, partial(self._read, time, before))

    @cached_property
    def _index(self) -> list[tuple[int, int, int, int]]:
        """Of each cloud: time, clouds of the same time before it, stamp, clouds of the same stamp
        up to it."""
        times: Counter[int] = Counter()
        names: Counter[int] = Counter()
        rows = []
        for _, time, data in self.opened.bag().raw({self.points}):
            stamp = self._stamp(data, time)
            names[stamp] += 1
            rows.append((time, times[time], stamp, names[stamp]))
            times[time] += 1
        return rows

    def _read(self, time: int, before: int) -> bytes:
        messages = self.opened.bag().raw({self.points}, time, time + 1)
        return next(islice(messages, before, None))[2]

    @cached_property
    def _beside(self) -> tuple[dict[int, GroundTruth], list, list]:
        """Labels by stamp, and calibrations and transforms by time: they are small, and may come
        after their cloud."""
        truth: dict[int, GroundTruth] = {}
        infos: list[tuple[int, Any]] = []
        transforms: list[tuple[int, Any]] = []
        bag = self.opened.bag()
        for topic, time, msg in bag.messages({TRUTH, CAMERA_INFO, EXTRINSICS} & {*bag.topics}):
            if topic == TRUTH:
                objects = from_marker_array(msg)
                truth[objects.stamp_ns or time] = to_truth(objects)
                if not objects.stamp_ns:  # of a cloud without a stamp, or where time begins
                    truth.setdefault(0, truth[time])
            else:
                (infos if topic == CAMERA_INFO else transforms).append((time, msg))
        return truth, infos, transforms

    @cached_property
    def files(self) -> tuple[Path, ...]:
        """That hold its messages."""
        if self.path.is_file():
            return self.path,
        return tuple(sorted(file for file in self.path.iterdir()
                            if file.is_file() and file.suffix != ".yaml"))

    @cached_property
    def first(self) -> tuple[int, bytes] | None:
        """Time of the first cloud, and it, serialised; None where there is none."""
        raw = self.opened.bag().raw({self.points})
        return next(((time, bytes(data)) for _, time, data in raw), None)

    def _stamp(self, data: bytes, time: int) -> int:
        """Return the header.stamp of a serialised cloud; its time in the bag if no cloud has one,
        or if it is too short for one."""
        if (stamp := _header_stamp(data)) == 0 and self._unstamped:
            stamp = None
        return time if stamp is None else stamp

    @cached_property
    def _unstamped(self) -> bool:
        """True if all stamps are 0; some are where simulated time begins."""
        return not any(_header_stamp(data) for *_, data in self.opened.bag().raw({self.points}))

    @cached_property
    def full_scale(self) -> float:
        """The intensity of a full reflection, by the first clouds, as only they can be read without
        a look through the bag; the same for all frames."""
        return scale_of(self._first_clouds(),
                        lambda data: read_raw_intensity(decode_cloud(data, self.kind)))

    def _first_clouds(self) -> Iterator[bytes]:
        with suppress(InputError):  # damage is named when it is read
            for _, _, data in islice(self.opened.bag().raw({self.points}), MAX_READ):
                yield bytes(data)

    @cached_property
    def poses(self) -> BagPoses:
        """Of the frame that the first cloud is in."""
        return BagPoses(self.opened, _frame_id(self.first[1]) if self.first else "")

    def _frame(self, i: int, time: int, stamp: int, which: int,
               data: Callable[[], bytes]) -> Frame:
        name = str(stamp) if which == 1 else f"{stamp}-{which}"  # recorders may not set the stamp
        return Frame(name, stamp, partial(self._load, time, data), partial(self._truth, stamp),
                     point_truth=partial(self._point_truth, time, data),
                     calibration=partial(self._calibration, time),
                     pose=lambda: self.poses(stamp), index=i, sensor_height=self.sensor_height,
                     files=self.files, native=lambda: decode_cloud(data(), self.kind),
                     intensity_max=lambda: self.full_scale)

    def _load(self, time: int, data: Callable[[], bytes]) -> LidarFrame:
        with self._named(time):
            return to_frame(decode_cloud(data(), self.kind), self.full_scale)[0]

    @contextmanager
    def _named(self, time: int) -> Iterator[None]:
        """Say in an InputError which cloud it is about."""
        try:
            yield
        except InputError as error:
            raise InputError(f"{self.path}, topic {self.points} at {time} ns: {error}") from None

    def labelled(self, data: bytes) -> Any:
        """A serialised cloud, decoded, if it has labels of its points; None otherwise, and if it is
        broken."""
        with suppress(InputError):
            msg = decode_cloud(data, self.kind)
            if {SEMANTIC, INSTANCE} <= {f.name for f in msg.fields}:
                return msg
        return None

    def _point_truth(self, time: int, data: Callable[[], bytes]) -> PointTruth | None:
        if (msg := self.labelled(data())) is None:
            return None
        with self._named(time):
            indices = to_frame(msg)[1]
            classes, instances = (read_column(msg, name, indices) for name in (SEMANTIC, INSTANCE))
        assert classes is not None and instances is not None  # labelled() has seen both
        return PointTruth(classes.astype(np.uint16), instances.astype(np.uint16))

    def _truth(self, stamp: int) -> GroundTruth | None:
        return self._beside[0].get(stamp)

    def _calibration(self, time: int) -> Calibration | None:
        _, infos, transforms = self._beside
        info, transform = _latest(infos, time), _latest(transforms, time)
        return read_calibration(info, transform) if info and transform else None


def _header_stamp(data: bytes) -> int | None:
    """header.stamp of a serialised message in ns; None if it is too short for one."""
    if len(data) < 12:
        return None
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(seconds * SECOND + nanoseconds)


def _frame_id(data: bytes) -> str:
    """header.frame_id of a serialised message; "" if it is too short to have one."""
    if len(data) < 16:
        return ""
    size, = struct.unpack_from("<I" if data[1] & 1 else ">I", data, 12)
    return bytes(data[16:16 + size]).rstrip(b"\0").decode(errors="replace")


def _latest(messages: list, time: int) -> Any:
    """The last message up to a time, or else the first: latched topics hold from the start."""
    after = bisect_right(messages, time, key=itemgetter(0))
    return messages[max(after - 1, 0)][1] if messages else None
