"""Point cloud files of other programs, and unsupported formats."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from samples import make_scene, write_file

from lidar_perception.data.cloud_files import read_points
from lidar_perception.data.open import open_recording
from lidar_perception.data.pcd import read_pcd
from lidar_perception.data.raw_clouds import open_clouds
from lidar_perception.types import InputError

CLOUD = make_scene(0)[:60].astype(np.float32)
PROPERTIES = {"f4": "float", "f8": "float64", "u1": "uchar", "i2": "int16"}


def load(path):
    (frame,) = open_recording(path)
    return frame.load()


def make_pcd_header(fields="x y z intensity", types="F F F F", sizes="4 4 4 4", data="binary", more=""):
    return (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n{more}"
        f"WIDTH {len(CLOUD)}\nHEIGHT 1\nPOINTS {len(CLOUD)}\nDATA {data}\n"
    )


def format_points(columns=CLOUD, form="{:.6f}"):
    return "\n".join(" ".join(form.format(v) for v in row) for row in columns.tolist())


def make_padded_pcd(count0):
    """Return a PCD file with padding and an empty field."""
    kind = np.dtype([("xyz", "<f4", 3), ("pad", "V4"), ("intensity", "<f4"), ("end", "V2")])
    points = np.zeros(len(CLOUD), kind)
    points["xyz"], points["intensity"] = CLOUD[:, :3], CLOUD[:, 3]
    return (
        make_pcd_header(
            f"x y z _ intensity {count0} _", "F F F U F U U", "4 4 4 1 4 1 1", more="COUNT 1 1 1 4 1 0 2\n"
        ).encode()
        + points.tobytes()
    )


PCD = {
    "upper-case suffix": ("one.PCD", make_pcd_header().encode() + CLOUD.tobytes()),
    "upper-case fields": (
        "one.pcd",
        make_pcd_header("X Y Z Intensity", sizes="8 8 8 8").encode() + CLOUD.astype("<f8").tobytes(),
    ),
    "other names": ("one.pcd", make_pcd_header("x y z scalar_Reflectance").encode() + CLOUD.tobytes()),
    "COLUMNS": (
        "one.pcd",
        (make_pcd_header(data="ascii").replace("FIELDS", "COLUMNS").replace("0.7", ".5") + format_points()).encode(),
    ),
    "no TYPE and SIZE": (
        "one.pcd",
        (
            "\n".join(line for line in make_pcd_header(data="ascii").split("\n") if line[:4] not in ("TYPE", "SIZE"))
            + format_points()
        ).encode(),
    ),
    "CRLF": ("one.pcd", (make_pcd_header(data="ascii") + format_points()).replace("\n", "\r\n").encode()),
    "CRLF in the header": ("one.pcd", make_pcd_header().replace("\n", "\r\n").encode() + CLOUD.tobytes()),
    "byte order mark": (
        "one.pcd",
        b"\xef\xbb\xbf" + make_pcd_header(data="ASCII", types="f f f f").encode() + format_points().encode(),
    ),
    "COUNT 0": ("one.pcd", make_padded_pcd("ring")),
    "COUNT 0 of padding": ("one.pcd", make_padded_pcd("_")),
    "stored, not compressed": (
        "one.pcd",
        make_pcd_header(data="binary_compressed").encode()
        + struct.pack("<II", CLOUD.nbytes, CLOUD.nbytes)
        + CLOUD.T.tobytes(),
    ),
    "fractions of an integer field": (
        "one.pcd",
        (make_pcd_header(types="F F F U", sizes="4 4 4 1", data="ascii") + format_points()).encode(),
    ),
}


@pytest.mark.parametrize("case", PCD)
def test_pcd_variants_are_read(tmp_path, case):
    name, content = PCD[case]
    write_file(tmp_path / name, content)
    for frame in (load(tmp_path / name), load(tmp_path)):
        np.testing.assert_allclose(frame.xyz, CLOUD[:, :3], atol=1e-6)
        np.testing.assert_allclose(frame.intensity, CLOUD[:, 3], atol=1e-6)
    assert "ring" not in read_points(tmp_path / name).dtype.names


def test_integers_with_decimal_point_keep_their_type(tmp_path):
    whole = np.column_stack([CLOUD[:, :3], np.arange(len(CLOUD))])
    path = write_file(
        tmp_path / "one.pcd", make_pcd_header(types="F F F U", sizes="4 4 4 1", data="ascii") + format_points(whole)
    )
    assert read_pcd(path).dtype["intensity"] == np.uint8
    assert read_pcd(path)["intensity"].tolist() == list(range(len(CLOUD)))


def make_ply(form, names=("x", "y", "z", "intensity"), kinds=("f4",) * 4, before="", skipped=b""):
    order = ">" if "big" in form else "<"
    head = f"ply\nformat {form} 1.0\ncomment made by a test\n{before}element vertex {len(CLOUD)}\n"
    head += "".join(f"property {PROPERTIES[kind]} {name}\n" for name, kind in zip(names, kinds))
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    cloud = np.empty(len(CLOUD), [(name, order + kind) for name, kind in zip(names, kinds)])
    for name, values in zip(names, CLOUD.T):
        cloud[name] = values
    body = format_points().encode() if form == "ascii" else cloud.tobytes()
    return head.encode() + skipped + body + b"\n3 0 1 2\n"


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize(
    "names, kinds",
    [
        (("x", "y", "z", "intensity"), ("f4", "f4", "f4", "f4")),
        (("X", "Y", "Z", "scalar_Intensity"), ("f8", "f8", "f8", "f4")),
        (("x", "y", "z", "reflectance"), ("f4", "f8", "f4", "f8")),
    ],
)
def test_ply_formats_are_read(tmp_path, form, names, kinds):
    frame = load(write_file(tmp_path / "one.PLY", make_ply(form, names, kinds)))
    np.testing.assert_allclose(frame.xyz, CLOUD[:, :3], atol=1e-6)
    np.testing.assert_allclose(frame.intensity, CLOUD[:, 3], atol=1e-6)


def test_ply_elements_before_the_vertices_are_skipped(tmp_path):
    before = "element camera 2\nproperty float a\nproperty uchar b\n"
    for form, skipped in (("ascii", b"1.5 2\n3.5 4\n"), ("binary_little_endian", bytes(10))):
        path = write_file(tmp_path / "one.ply", make_ply(form, before=before, skipped=skipped))
        np.testing.assert_allclose(load(path).xyz, CLOUD[:, :3], atol=1e-6)


@pytest.mark.parametrize(
    "content, words",
    [
        (b"", "the first line is not 'ply'"),
        (b"ply\nformat ascii 1.0\n", "end_header is missing"),
        (b"ply\nformat ascii 1.0\nend_header\n", "element vertex is missing"),
        (b"ply\nelement vertex 1\nproperty float x\nend_header\n1\n", "line format is missing"),
        (b"ply\nformat odd 1.0\nend_header\n", "odd"),
        (make_ply("ascii")[:900], "it is truncated"),
        (make_ply("binary_big_endian")[:900], "it is truncated"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n1\n",
            "x of vertex elements is a list",
        ),
        (make_ply("ascii", ("x", "y", "w", "v")), "has no field z"),
    ],
)
def test_invalid_ply_file_is_reported(tmp_path, content, words):
    write_file(tmp_path / "one.ply", content)
    with pytest.raises(InputError, match=rf"one\.ply .*{words}") as error:
        load(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "array, intensity",
    [
        (CLOUD, True),
        (CLOUD[:, :3], False),
        (CLOUD.astype(np.float64), True),
        (np.column_stack([CLOUD, CLOUD[:, 0]]), True),
        (np.asfortranarray(CLOUD), True),
        (CLOUD.view([(name, "<f4") for name in ("X", "y", "z", "Intensity")]).ravel(), True),
    ],
)
def test_npy_files_are_read(tmp_path, array, intensity):
    np.save(tmp_path / "one.npy", array)
    frame = load(tmp_path)
    assert np.array_equal(frame.xyz, CLOUD[:, :3])
    assert np.array_equal(frame.intensity, CLOUD[:, 3]) if intensity else frame.intensity is None


@pytest.mark.parametrize(
    "make",
    [
        lambda p: np.save(p, CLOUD.T),
        lambda p: np.save(p, CLOUD.astype(np.int32)),
        lambda p: np.save(p, np.array([{}]), allow_pickle=True),
        lambda p: write_file(p, b"\x93NUMPY"),
        lambda p: np.save(p, np.zeros((5, 2), np.float32)),
        lambda p: write_file(p, b""),
        lambda p: (np.save(p, CLOUD), write_file(p, p.read_bytes().replace(b"(60, 4)", b"(60,(60,"))),
        lambda p: (np.save(p, CLOUD), write_file(p, p.read_bytes().replace(b"(60, 4)", b"(9**99,"))),
        lambda p: (np.save(p, CLOUD), write_file(p, p.read_bytes().replace(b"(60, 4)", b"(60, 5)"))),
    ],
)
def test_invalid_npy_file_is_reported(tmp_path, make):
    make(tmp_path / "one.npy")
    with pytest.raises(InputError, match=r"one\.npy .*(save it again|expected \(N, 3\))") as error:
        load(tmp_path)
    assert "\n" not in str(error.value)


def test_map_coordinates_are_reported_with_remedy(tmp_path):
    far = CLOUD.astype(np.float64) + [513_000, 5_404_000, 300, 0]
    np.save(tmp_path / "one.npy", far)
    with pytest.raises(
        InputError,
        match=r"one\.npy: all points are beyond 100 km.*subtract an "
        "offset, such as 513000 5404000, from x y",
    ):
        load(tmp_path)
    far[0, :3] = 1, 2, 3  # one point in range; the others are invalid returns
    np.save(tmp_path / "one.npy", far)
    assert len(load(tmp_path)) == 1
    np.save(tmp_path / "one.npy", np.full((5, 3), np.nan))
    assert len(load(tmp_path)) == 0


FIRST = 1_741_286_117


@pytest.mark.parametrize(
    "names, expected",
    [
        # SECONDS.NANOSECONDS without leading zeros, by old versions of pointcloud_to_pcd
        ([f"{FIRST}.{i * 10**8 + 11_149_430}" for i in range(10)], [i * 10**8 + 11_149_430 for i in range(10)]),
        ([f"{FIRST}.{i * 10**8 + 7}" for i in range(3)], [i * 10**8 + 7 for i in range(3)]),
        ([f"{FIRST}.5000", f"{FIRST}.100005000"], [5000, 100_005_000]),
        # decimal fractions, zero-padded or as printed floats
        ([f"{FIRST}.{i * 10**8 + 11_149_430:09}" for i in range(10)], [i * 10**8 + 11_149_430 for i in range(10)]),
        ([f"{FIRST}.1", f"{FIRST}.2", f"{FIRST}.3000001"], [10**8, 2 * 10**8, 300_000_100]),
        ([f"{FIRST}.05", f"{FIRST}.123456789"], [5 * 10**7, 123_456_789]),
        ([f"{FIRST}.1", f"{FIRST}.2", f"{FIRST}.300000001"], [10**8, 2 * 10**8, 300_000_001]),
    ],
)
def test_times_in_file_names_need_no_leading_zeros(tmp_path, names, expected):
    for name in names:
        write_file(tmp_path / f"{name}.BIN", CLOUD.tobytes())
    recording = open_recording(tmp_path)
    assert [f.stamp_ns - FIRST * 10**9 for f in recording] == sorted(expected)
    assert [f.name for f in recording] == names and recording.has_times
    assert open_clouds(tmp_path).stamps_ns.tolist() == [f.stamp_ns for f in recording]


@pytest.mark.parametrize(
    "file, words",
    [
        ("scan.LAS", r"format LAS .*pdal"),
        ("scan.laz", r"format LAZ .*pdal"),
        ("a.e57", r"format E57 .*pdal"),
        ("segment-1/x.tfrecord", r"format Waymo .*KITTI"),
        ("training/lidar/x.parquet", r"format Waymo .*KITTI"),
        ("val/log/sensors/lidar/1.feather", r"format Argoverse 2 .*av2"),
        ("drive.pcap", r"sensor packets .*driver"),
        ("drive.pcapng", "sensor packets"),
        ("drive.lvx2", "Livox Viewer.*lvx_to_rosbag"),
        ("drive.osf", "ouster-cli source"),
    ],
)
def test_unsupported_formats_are_reported_with_a_converter(tmp_path, file, words):
    path = write_file(tmp_path / file, b"LASF")
    for source in (path, tmp_path):
        for opener in (open_recording, open_clouds):
            with pytest.raises(InputError, match=words) as error:
                opener(source)
            assert "\n" not in str(error.value) and path.name in str(error.value)
