"""Bags of other recorders and versions, and edited bags."""

from __future__ import annotations

import itertools
import shutil
import sqlite3

import pytest
import zstandard
from bag_samples import as_ros1, copy_with_metadata, message_bytes
from mcap.writer import CompressionType, IndexType, Writer

from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.open import open_recording
from lidar_perception.testing.bags import copy_bag
from lidar_perception.types import InputError, InputWarning
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.topics import POINTS

pytestmark = pytest.mark.usefixtures("no_warning")
STATE = "my_robot_msgs/msg/State"


def write_mcap(
    path,
    bag,
    rows,
    *,
    profile="ros2",
    encoding="cdr",
    definition="ros2msg",
    short_names=False,
    channels=1,
    late=False,
    **options,
):
    """Write rows to `channels` channels per topic. With `late`, all channels are defined first."""
    with open(path, "wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile=profile)
        known = {}

        def channel(topic, number):
            if (topic, number) not in known:
                kind = bag.topics[topic]
                schema = writer.register_schema(kind.replace("/msg", "") if short_names else kind, definition, b"")
                known[topic, number] = writer.register_channel(topic, encoding, schema, {})
            return known[topic, number]

        if late:
            for topic in bag.topics:
                channel(topic, 0)
        for i, (topic, time, data) in enumerate(rows):
            writer.add_message(channel(topic, i % channels), time, data, time)
        writer.finish()
    return path


NO_SUMMARY = dict(
    index_types=IndexType.NONE,
    repeat_channels=False,
    repeat_schemas=False,
    use_statistics=False,
    use_summary_offsets=False,
)


@pytest.mark.parametrize(
    "options",
    [
        {},
        dict(chunk_size=1),
        dict(index_types=IndexType.CHUNK),
        dict(index_types=IndexType.MESSAGE),
        dict(index_types=IndexType.NONE),
        dict(repeat_channels=False),
        dict(repeat_schemas=False),
        dict(chunk_size=1, late=True, repeat_channels=False, repeat_schemas=False),
        dict(use_statistics=False),
        dict(use_summary_offsets=False),
        NO_SUMMARY,
        dict(use_chunking=False),
        dict(use_chunking=False, **NO_SUMMARY),
        dict(enable_crcs=False),
        dict(enable_data_crcs=True),
        dict(compression=CompressionType.LZ4),
        dict(compression=CompressionType.NONE, chunk_size=1),
        dict(profile=""),
        dict(profile="other"),
        dict(definition="ros2idl"),
        dict(definition="unknown"),
        dict(definition=""),
        dict(short_names=True),
        dict(encoding=""),
        dict(channels=3),
    ],
    ids=str,
)
def test_mcap_file_of_any_writer_is_read(sample_bag, messages, tmp_path, options):
    with Bag(sample_bag) as bag:
        path = write_mcap(tmp_path / "a.mcap", bag, messages, **options)
        with Bag(path) as other:
            assert (other.topics, other.counts) == (bag.topics, bag.counts)
            assert (other.start_ns, other.end_ns) == (bag.start_ns, bag.end_ns)
            assert list(other.raw_messages()) == messages
            last = messages[-1][1]
            assert list(other.raw_messages(None, last)) == [row for row in messages if row[1] == last]


def test_messages_inside_and_outside_chunks_are_merged(sample_bag, messages, tmp_path):
    """The MCAP specification allows both in one file."""
    with Bag(sample_bag) as bag:
        plain = write_mcap(tmp_path / "a", bag, messages[::2], late=True, use_chunking=False, **NO_SUMMARY)
        chunked = write_mcap(tmp_path / "b", bag, messages[1::2], late=True, chunk_size=1, **NO_SUMMARY)
    body, end = plain.read_bytes()[: -37 - 13], chunked.read_bytes()
    header = 8 + 9 + int.from_bytes(end[9:17], "little")
    (tmp_path / "c.mcap").write_bytes(body + end[header:])
    assert sorted(message_bytes(tmp_path / "c.mcap")) == sorted(messages)


def test_unreadable_topics_do_not_affect_others(sample_bag, messages, tmp_path):
    with open(tmp_path / "a.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="")
        for topic, kind, definition, encoding in (
            (POINTS, "sensor_msgs/msg/PointCloud2", "ros2msg", "cdr"),
            ("/state", STATE, "unknown", "cdr"),
            ("/log", "foxglove.Log", "protobuf", "protobuf"),
        ):
            channel = writer.register_channel(topic, encoding, writer.register_schema(kind, definition, b""))
            for name, time, data in messages:
                if name == POINTS:
                    writer.add_message(channel, time, data, time)
        writer.finish()
    assert len(open_recording(tmp_path / "a.mcap")) == 3
    with Bag(tmp_path / "a.mcap") as bag:
        assert bag.topics == {POINTS: "sensor_msgs/msg/PointCloud2", "/state": STATE}
        assert [*bag.unreadable] == ["/log"] and "/log (foxglove.Log as protobuf)" in bag.content
        with pytest.raises(InputError, match=r"foxglove\.Log as protobuf on /log"):
            bag.require("/log")


def test_topic_with_two_types_is_read_as_the_more_frequent(sample_bag, messages, tmp_path):
    clouds = [row for row in messages if row[0] == POINTS]
    with open(tmp_path / "a.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for kind, found in ((STATE, clouds[:1]), ("sensor_msgs/msg/PointCloud2", clouds)):
            channel = writer.register_channel(POINTS, "cdr", writer.register_schema(kind, "ros2msg", b""))
            for _, time, data in found:
                writer.add_message(channel, time, data, time)
        writer.finish()
    with pytest.warns(InputWarning, match=f"of several types; only .*PointCloud2 is read, not 1 of {STATE}"):
        assert message_bytes(tmp_path / "a.mcap") == clouds


SCHEMAS = {  # columns of the table topics, by distribution
    "dashing": "id INTEGER PRIMARY KEY, name TEXT, type TEXT",
    "foxy": "id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, offered_qos_profiles TEXT",
    "jazzy": "id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT, "
    "offered_qos_profiles TEXT, type_description_hash TEXT",
}


def write_sqlite(path, bag, rows, schema="jazzy", mode="DELETE"):
    """Write rows and return the open database; the second half is committed last."""
    database = sqlite3.connect(path)
    database.execute(f"PRAGMA journal_mode={mode}")
    database.execute("PRAGMA wal_autocheckpoint=0")
    columns = SCHEMAS[schema]
    database.execute(f"CREATE TABLE topics({columns})")
    database.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    database.execute(
        "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, "
        "encoding TEXT, encoded_message_definition TEXT, type_description_hash TEXT)"
    )
    ids = {topic: i for i, topic in enumerate(bag.topics, 1)}
    for topic, i in ids.items():
        values = [i, topic, bag.topics[topic], "cdr", "", ""][: columns.count(",") + 1]
        database.execute(f"INSERT INTO topics VALUES({','.join('?' * len(values))})", values)
        database.execute("INSERT INTO message_definitions VALUES(?, ?, 'unknown', '', '')", (i, bag.topics[topic]))
    for part in (rows[: len(rows) // 2], rows[len(rows) // 2 :]):
        database.executemany(
            "INSERT INTO messages(topic_id, timestamp, data) VALUES(?, ?, ?)",
            [(ids[topic], time, data) for topic, time, data in part],
        )
        database.commit()
        if part[0] is rows[0]:
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    return database


@pytest.mark.parametrize("schema", SCHEMAS)
def test_sqlite_file_of_any_distribution_is_read(sample_bag, messages, tmp_path, schema):
    with Bag(sample_bag) as bag:
        write_sqlite(tmp_path / "a?b#c%20.db3", bag, messages, schema).close()
        with Bag(tmp_path / "a?b#c%20.db3") as other:
            assert (other.topics, other.counts) == (bag.topics, bag.counts)
            assert [*other.raw_messages()] == messages


@pytest.mark.parametrize("shm", [True, False])
def test_sqlite_wal_is_read_from_a_read_only_folder(sample_bag, messages, tmp_path, shm):
    """The recorder's preset resilient leaves such a file after a crash."""
    with Bag(sample_bag) as bag:
        database = write_sqlite(tmp_path / "a.db3", bag, messages, mode="WAL")
    (tmp_path / "bag").mkdir()
    for end in ("", "-wal", "-shm")[: 3 if shm else 2]:
        shutil.copy(tmp_path / f"a.db3{end}", tmp_path / "bag")
    database.close()
    files = {file: file.read_bytes() for file in (tmp_path / "bag").iterdir()}
    for file in files:
        file.chmod(0o444)
    (tmp_path / "bag").chmod(0o555)
    assert len(files[tmp_path / "bag/a.db3-wal"]) > 0
    assert message_bytes(tmp_path / "bag") == message_bytes(tmp_path / "bag/a.db3") == messages
    assert {file: file.read_bytes() for file in (tmp_path / "bag").iterdir()} == files
    (tmp_path / "bag").chmod(0o755)


def test_unsupported_compression_is_reported(sample_bag, tmp_path):
    path = copy_with_metadata(
        sample_bag, tmp_path / "bag", lambda info: info.update(compression_mode="FILE", compression_format="lz4")
    )
    with pytest.raises(InputError, match=r"compressed by lz4, which is not supported; .*ros2 bag"):
        Bag(path)


def compress(data: bytes) -> bytes:
    return zstandard.ZstdCompressor().compress(data)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("metadata", [True, False])
def test_compressed_files_are_read(sample_bag, messages, tmp_path, storage, metadata):
    path = copy_bag(sample_bag, tmp_path / "bag", storage)
    (file,) = (file for file in path.iterdir() if file.suffix != ".yaml")
    (path / f"{file.name}.zstd").write_bytes(compress(file.read_bytes()))
    file.unlink()
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace(file.name, f"{file.name}.zstd"))
    if not metadata:
        (path / "metadata.yaml").unlink()
    assert message_bytes(path) == messages
    whole = path / f"{file.name}.zstd"
    whole.write_bytes(whole.read_bytes()[:1000])
    with pytest.raises(InputError, match=rf"{file.name}.zstd is truncated or damaged"):
        message_bytes(path)


def test_compressed_messages_are_read(sample_bag, messages, tmp_path):
    with Bag(sample_bag) as bag:
        path = write_mcap(tmp_path / "a.mcap", bag, [(topic, time, compress(data)) for topic, time, data in messages])
    assert message_bytes(path) == messages


def write_parts(folder, stamps):
    """Write bags, each with a text at its stamps, and yield their paths."""
    for i, part in enumerate(stamps):
        with BagWriter(folder / f"part{i}") as bag:
            bag.add_topic("/text", "std_msgs/msg/String")
            for stamp in part:
                bag.write("/text", stamp, make_bag_message("std_msgs/msg/String", data=str(stamp)))
        yield folder / f"part{i}"


@pytest.mark.parametrize("kind", ["drive_{}.mcap", "drive_{}.db3", "drive_2024-01-01_{}.bag", "any{}.bag"])
@pytest.mark.parametrize(
    "stamps", [([10, 20], [30, 40], [50]), ([50, 60], [30], [10, 20]), ([10, 30, 50], [20, 40], [30]), ([], [10], [])]
)
def test_files_of_a_drive_are_read_in_time_order(tmp_path, kind, stamps):
    """Without metadata.yaml, as after a crash or from ROS 1; the files may overlap in time."""
    (tmp_path / "drive").mkdir()
    for i, part in enumerate(write_parts(tmp_path, stamps)):
        file = tmp_path / "drive" / kind.format(i)
        if file.suffix == ".bag":
            as_ros1(part, file)
        elif file.suffix == ".db3":
            copied = copy_bag(part, tmp_path / f"copied{i}", "sqlite3")
            shutil.copy(copied / f"{copied.name}.db3", file)
        else:
            shutil.copy(part / f"{part.name}.mcap", file)
    times = sorted(itertools.chain(*stamps))
    with Bag(tmp_path / "drive") as bag:
        assert [time for _, time, _ in bag.raw_messages()] == times
        assert bag.counts == {"/text": len(times)}
        assert (bag.start_ns, bag.end_ns) == (times[0], times[-1] + 1)
        assert [time for _, time, _ in bag.raw_messages(None, 20, 40)] == [time for time in times if 20 <= time < 40]


def test_folder_of_ros1_bags_is_one_drive(sample_bag, tmp_path):
    with Bag(sample_bag) as bag:
        clouds = [*bag.raw_messages({POINTS})]
        for i in range(3):
            with BagWriter(tmp_path / f"part{i}") as part:
                part.add_topic(POINTS, bag.topics[POINTS])
                part.write(*clouds[i])
            (tmp_path / "drive").mkdir(exist_ok=True)
            as_ros1(tmp_path / f"part{i}", tmp_path / f"drive/drive_{i}.bag", "bz2")
    recording, expected = open_recording(tmp_path / "drive"), open_recording(sample_bag)
    assert "ROS 1 bag, clouds on /points" in str(recording)
    assert [(f.stamp_ns, len(f.load())) for f in recording] == [(f.stamp_ns, len(f.load())) for f in expected]
