"""Raw clouds with all columns, from any kind of file."""

import struct

import numpy as np
import pytest

from lidar_perception.data.bag import BagWriter
from lidar_perception.data.cloud_files import read_points
from lidar_perception.data.open import open_recording
from lidar_perception.data.pcd import decompress_lzf, read_pcd
from lidar_perception.data.raw_clouds import choose_clouds, open_clouds
from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array, to_array
from msg_utils.stamps import make_header

LAYOUT = [
    ("x", "<f4"),
    ("y", "<f4"),
    ("z", "<f4"),
    ("intensity", "u1"),
    ("ring", "<u2"),
    ("t", "<u4"),
    ("normal", "<f4", (3,)),
    ("stamp", "<u8"),
]


def make_points(n=200):
    rng = np.random.default_rng(1)
    points = np.zeros(n, LAYOUT)
    for name in points.dtype.names:
        part = points[name]
        part[...] = (
            rng.normal(0, 10, part.shape)
            if part.dtype.kind == "f"
            else rng.integers(0, np.iinfo(part.dtype).max // 2, part.shape, np.int64)
        )
    points["ring"] = np.arange(n) // 20  # runs of equal values, which compress well
    return points


def compress_lzf(data):
    """Compress with greedy LZF: references to earlier runs of at least three bytes, literals otherwise."""
    out, literal, positions, i = bytearray(), bytearray(), {}, 0

    def flush():
        for k in range(0, len(literal), 32):
            out.append(len(literal[k : k + 32]) - 1)
            out.extend(literal[k : k + 32])
        literal.clear()

    while i < len(data):
        key, length = data[i : i + 3], 0
        back = i - positions.get(key, -1) - 1
        if len(key) == 3 and key in positions and back < 8192:
            start = positions[key]
            while i + length < len(data) and length < 264 and (data[start + length] == data[i + length]):
                length += 1
            flush()
            short = min(length - 2, 7)
            out.append(short << 5 | back >> 8)
            if short == 7:
                out.append(length - 9)
            out.append(back & 255)
            positions[key] = i
            i += length
        else:
            positions[key] = i
            literal.append(data[i])
            i += 1
    flush()
    return bytes(out)


def format_pcd(cloud, kind):
    kinds = {"f": "F", "u": "U", "i": "I"}
    parts = [cloud.dtype[name] for name in cloud.dtype.names]
    head = "\n".join(
        (
            "# .PCD v0.7",
            "VERSION 0.7",
            "FIELDS " + " ".join(cloud.dtype.names),
            "SIZE " + " ".join(str(p.base.itemsize) for p in parts),
            "TYPE " + " ".join(kinds[p.base.kind] for p in parts),
            "COUNT " + " ".join(str(int(np.prod(p.shape, dtype=int))) for p in parts),
            f"WIDTH {len(cloud)}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {len(cloud)}",
            f"DATA {kind}",
            "",
        )
    ).encode()
    if kind == "ascii":
        return (
            head
            + "\n".join(
                " ".join(repr(v.item()) for name in cloud.dtype.names for v in np.atleast_1d(row[name]))
                for row in cloud
            ).encode()
        )
    if kind == "binary":
        return head + cloud.tobytes()
    plain = b"".join(np.ascontiguousarray(cloud[name]).tobytes() for name in cloud.dtype.names)
    data = compress_lzf(plain)
    return head + struct.pack("<II", len(data), len(plain)) + data


@pytest.mark.parametrize("kind", ["ascii", "binary", "binary_compressed"])
def test_pcd_file_returns_the_written_points(tmp_path, kind):
    path = tmp_path / "one.pcd"
    path.write_bytes(format_pcd(make_points(), kind))
    assert read_pcd(path).dtype.names == make_points().dtype.names
    assert np.array_equal(read_pcd(path), make_points())
    for length in (0, 40, len(path.read_bytes()) // 2):
        path.write_bytes(format_pcd(make_points(), kind)[:length])
        with pytest.raises(InputError, match=r"one\.pcd") as error:
            read_pcd(path)
        assert "\n" not in str(error.value)


def test_integers_in_text_keep_all_digits(tmp_path):
    path = tmp_path / "one.pcd"
    for name in ("u1", "i1", "u4", "i8", "u8"):
        limits = np.iinfo(name)
        cloud = np.array([(limits.min,), (limits.max,)], [("n", name)])
        path.write_bytes(format_pcd(cloud, "ascii"))
        assert np.array_equal(read_pcd(path), cloud)


@pytest.mark.parametrize("data", [b"", b"a", b"abc" * 500, bytes(9000), bytes(range(256)) * 40])
def test_lzf_data_are_decompressed(data):
    assert decompress_lzf(compress_lzf(data), len(data)) == data
    with pytest.raises(ValueError):
        decompress_lzf(compress_lzf(data), len(data) + 1)


ONE = "FIELDS x\nSIZE 4\nTYPE F\n"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "FIELDS x\nDATA binary\n",
        "no cloud",
        ONE + "POINTS 999999999999\nDATA binary\n",
        ONE.replace("F\n", "Q\n") + "POINTS 1\nDATA ascii\n1",
        ONE + "POINTS 1\nDATA zip\n1",
        ONE.replace("4", "0") + "POINTS 1\nDATA ascii\n1",
        *(
            f"FIELDS n\nSIZE {size}\nTYPE {kind}\nPOINTS 1\nDATA ascii\n{number}"
            for size, kind, number in ((1, "U", 256), (2, "U", -1), (1, "I", 128), (8, "U", 2**64), (8, "I", 2**63))
        ),
    ],
)
def test_invalid_pcd_file_is_reported(tmp_path, text):
    path = tmp_path / "one.pcd"
    path.write_text(text)
    with pytest.raises(InputError, match=r"one\.pcd"):
        read_pcd(path)


def test_cloud_files_and_folders_are_opened(tmp_path):
    for i in range(3):
        (tmp_path / f"{i}.pcd").write_bytes(format_pcd(make_points(50 + i), "binary"))
    clouds = open_clouds(tmp_path)
    assert clouds.count == 3 and clouds.stamps_ns is None and "3 .pcd files" in clouds.layout
    assert [len(to_array(clouds.load(i))) for i in range(3)] == [50, 51, 52]
    assert open_clouds(tmp_path / "1.pcd").count == 1
    rng = np.random.default_rng(0)
    four = rng.normal(0, 10, (500, 4)).astype(np.float32)  # same number of bytes as 400 records of five
    four[:, 3] = abs(four[:, 3])
    (tmp_path / "a.bin").write_bytes(four.tobytes())
    five = np.column_stack([four, rng.integers(0, 32, 500)]).astype(np.float32)
    (tmp_path / "b.bin").write_bytes(five.tobytes())
    a, b = (to_array(open_clouds(tmp_path / name).load(0)) for name in ("a.bin", "b.bin"))
    assert a.dtype.names == ("x", "y", "z", "intensity")
    assert b.dtype.names == (*a.dtype.names, "ring")
    assert np.array_equal(a["z"], four[:, 2]) and np.array_equal(b["ring"], five[:, 4])
    with pytest.raises(InputError, match="does not exist"):
        open_clouds(tmp_path / "none")


@pytest.mark.parametrize("more", [("time",), ("ring", "time"), ("r", "g", "b")])
def test_records_with_other_columns_are_rejected(tmp_path, more):
    rng = np.random.default_rng(0)
    cloud = np.column_stack([rng.normal(0, 10, (400, 3)), rng.random((400, 1 + len(more)))])
    (tmp_path / "one.bin").write_bytes(cloud.astype(np.float32).tobytes())
    with pytest.raises(InputError, match=r"one\.bin does not have the columns .* save the cloud as \.pcd"):
        read_points(tmp_path / "one.bin")


def make_bag_points(n):
    points = make_points(n)
    layout = [(name, kind) for name, kind, *_ in LAYOUT[:5]]
    cloud = np.empty(n, layout)
    for name, _ in layout:
        cloud[name] = points[name]
    return cloud


def write_clouds(path, topics, count=4):
    with BagWriter(path) as bag:
        for topic in topics:
            bag.add_topic(topic, "sensor_msgs/msg/PointCloud2")
        for i in range(count):
            for topic in topics:
                header = make_header(i * 10**8, topic.strip("/"), make_bag_message)
                message = from_array(make_bag_points(90 + i), header, make_bag_message)
                bag.write(topic, i * 10**8, message)


def test_bag_with_several_sensors_needs_a_topic(tmp_path):
    write_clouds(tmp_path / "one", ["/front/scan"])
    clouds = open_clouds(tmp_path / "one")
    assert clouds.count == 4 and clouds.stamps_ns.tolist() == [0, 10**8, 2 * 10**8, 3 * 10**8]
    assert np.array_equal(to_array(clouds.load(2)), make_bag_points(92))
    write_clouds(tmp_path / "three", ["/left", "/right", "/rear"])
    with pytest.raises(InputError, match="on /left, /rear, /right; choose"):
        open_clouds(tmp_path / "three")
    assert open_clouds(tmp_path / "three", "/rear").load(1).header.frame_id == "rear"
    with pytest.raises(InputError, match="no topic /other"):
        open_clouds(tmp_path / "three", "/other")


def test_times_in_file_names_are_read_as_stamps(tmp_path):
    for name in ("1700000000.1", "1700000000.2"):
        (tmp_path / f"{name}.pcd").write_bytes(format_pcd(make_points(), "ascii"))
    clouds = open_clouds(tmp_path)
    assert clouds.stamps_ns.tolist() == [17 * 10**17 + 10**8, 17 * 10**17 + 2 * 10**8]
    assert clouds.load(1).header.stamp.nanosec == 2 * 10**8
    (tmp_path / "another.pcd").write_bytes(format_pcd(make_points(), "ascii"))
    assert open_clouds(tmp_path).stamps_ns is None


@pytest.mark.parametrize(
    "names, timed",
    [
        (["1700000000.1", "1700000000.19998", "1700000000.4", "1700000001"], True),  # str(time)
        (["0000000000", "0000000001", "0000000010"], False),
    ],
)  # KITTI's frame numbers
def test_files_are_ordered_by_time_or_number(names, timed, tmp_path):
    for name in reversed(names):
        (tmp_path / f"{name}.pcd").write_bytes(format_pcd(make_points(), "ascii"))
    recording = open_recording(tmp_path)
    assert [frame.name for frame in recording] == names
    stamps = [frame.stamp_ns for frame in recording]
    assert stamps == sorted(stamps) and timed == ("no times" not in recording.layout)
    assert timed == (stamps[-1] == 1_700_000_001 * 10**9)


def test_evenly_spaced_pairs_of_clouds_are_chosen():
    assert choose_clouds(5, 10) == [0, 1, 2, 3, 4]
    indices = choose_clouds(1000, 40)
    assert len(indices) == 40 and indices[:2] == [0, 1] and indices[-1] == 999
    assert np.diff(indices)[::2].tolist() == [1, 8] * 10 and (np.diff(indices)[1::2] > 40).all()
    assert choose_clouds(3, 1) == [0] and choose_clouds(1, 1) == [0]
    for count in range(1, 60):
        for max_count in range(1, 45):
            indices = choose_clouds(count, max_count)
            assert indices == sorted({*indices}) and indices[0] == 0 and indices[-1] < count
            assert len(indices) <= max_count and (count == 1 or len(indices) > 1 or max_count == 1)
