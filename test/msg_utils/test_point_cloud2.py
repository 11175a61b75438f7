"""Conversion of PointCloud2 to structured arrays and back, byte by byte."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples import each_make, make_any_header

from msg_utils.point_cloud2 import (
    DATATYPES,
    CloudError,
    add_columns,
    compute_dtype,
    from_array,
    make_point_fields,
    read_columns,
    read_xyz,
    to_array,
)

pytestmark = pytest.mark.no_cover  # covered by other tests

XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


@st.composite
def draw_layouts(draw) -> np.dtype:
    """Draw dtypes of clouds with all datatypes, gaps, counts, byte orders and field orders."""
    names = draw(st.lists(st.sampled_from(["x", "y", "z", "intensity", "ring", "t"]), min_size=1, unique=True))
    order = draw(st.sampled_from("<>"))
    gaps = st.integers(0, 5)
    formats, offsets, end = [], [], 0
    for _ in names:
        base = np.dtype(order + draw(st.sampled_from(sorted(DATATYPES.values()))))
        count = draw(st.sampled_from([1, 1, 1, 2, 5]))
        offsets.append(end + draw(gaps))
        formats.append(base if count == 1 else (base, (count,)))
        end = offsets[-1] + base.itemsize * count
    listed = draw(st.permutations(range(len(names))))
    return np.dtype(
        dict(
            names=names,
            formats=[formats[i] for i in listed],
            offsets=[offsets[i] for i in listed],
            itemsize=end + draw(gaps),
        )
    )


@st.composite
def draw_points(draw, count=st.integers(0, 12)) -> np.ndarray:
    """Draw points of any layout with random bits, including NaN and padding."""
    dtype, n = draw(draw_layouts()), draw(count)
    seed = draw(st.integers(0, 2**16))
    raw = np.random.default_rng(seed).integers(0, 256, n * dtype.itemsize, dtype=np.uint8)
    return raw.view(dtype) if n else np.zeros(0, dtype)


def make_field(make, name, offset, datatype=7, count=1):
    return make("sensor_msgs/msg/PointField", name=name, offset=offset, datatype=datatype, count=count)


def make_message(make, fields, data, *, height=1, width=1, point_step, row_step=None, big=False):
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=make_any_header(make),
        height=height,
        width=width,
        fields=fields,
        point_step=point_step,
        data=data,
        is_bigendian=big,
        row_step=width * point_step if row_step is None else row_step,
    )


def make_two_fields(make, *, names="ab", datatypes=(7, 7), count=1, **shape):
    """Make a cloud of three points with two float32 fields; `shape` changes its layout."""
    fields = [make_field(make, names[0], 0, datatypes[0]), make_field(make, names[1], 4, datatypes[1], count)]
    return make_message(make, fields, np.zeros(24, np.uint8), **dict(width=3, point_step=8) | shape)


def is_big_endian(dtype: np.dtype) -> bool:
    return any(dtype[n].base.byteorder == ">" for n in dtype.names)


def make_padded_cloud(make, cloud: np.ndarray, height: int, pad: int, unnamed=()):
    """Make an organised cloud with `pad` bytes of 0xAA after each row."""
    rows = np.frombuffer(cloud.tobytes(), np.uint8).reshape(height, -1)
    data = np.pad(rows, [(0, 0), (0, pad)], constant_values=0xAA)
    fields = [*make_point_fields(cloud.dtype, make), *(make_field(make, "", at, 2) for at in unnamed)]
    return make_message(
        make,
        fields,
        data.reshape(-1),
        height=height,
        width=len(cloud) // height,
        point_step=cloud.dtype.itemsize,
        row_step=data.shape[1],
        big=is_big_endian(cloud.dtype),
    )


def repeat_cloud(cloud: np.ndarray, times: int) -> np.ndarray:
    """Repeat a cloud, including the bytes between fields, which np.concatenate drops."""
    return np.ndarray(len(cloud) * times, cloud.dtype, cloud.tobytes() * times)


def are_equal_arrays(a: np.ndarray, b: np.ndarray) -> bool:
    """Return True if all fields are equal bit by bit, ignoring padding."""
    return (
        len(a) == len(b)
        and a.dtype.names == b.dtype.names
        and all(a[n].dtype == b[n].dtype and a[n].tobytes() == b[n].tobytes() for n in a.dtype.names)
    )


@each_make
@given(cloud=draw_points())
def test_array_survives_conversion_to_a_cloud_and_back(make, cloud):
    result = to_array(from_array(cloud, make_any_header(make), make))
    assert result.dtype == cloud.dtype
    assert result.tobytes() == cloud.tobytes()


@each_make
@given(cloud=draw_points(), height=st.integers(1, 3))
def test_from_array_sets_all_fields_of_the_message(make, cloud, height):
    cloud = repeat_cloud(cloud, height)
    msg = from_array(cloud, make_any_header(make), make, height=height, is_dense=False)
    assert (msg.height, msg.height * msg.width) == (height, len(cloud))
    assert msg.point_step == cloud.dtype.itemsize
    assert msg.row_step == msg.width * msg.point_step
    assert len(msg.data) == msg.height * msg.row_step
    assert msg.header.frame_id == "velodyne" and not msg.is_dense


@each_make
@given(cloud=draw_points(st.integers(1, 6)))
def test_strided_view_gives_the_same_cloud_as_its_copy(make, cloud):
    wide = np.repeat(cloud, 2)
    assert are_equal_arrays(to_array(from_array(wide[::2], make_any_header(make), make)), cloud)


@each_make
@given(cloud=draw_points(st.integers(1, 6)), height=st.integers(1, 3), pad=st.integers(0, 9))
def test_padding_at_the_end_of_a_row_is_not_read(make, cloud, height, pad):
    cloud = repeat_cloud(cloud, height)
    assert are_equal_arrays(to_array(make_padded_cloud(make, cloud, height, pad)), cloud)


@each_make
def test_last_row_needs_no_padding(make):
    cloud = np.arange(12, dtype="<f4").view(XYZ)
    msg = make_padded_cloud(make, cloud, 2, 8)
    msg.data = msg.data[:-8]
    assert are_equal_arrays(to_array(msg), cloud)


@each_make
def test_fields_without_a_name_are_padding(make):
    fields = [make_field(make, "", 0, 2, 4), make_field(make, "x", 4), make_field(make, "", 8, 2, 4)]
    data = np.array([9.0, 1.5, 9.0, 9.0, 2.5, 9.0], "<f4").view(np.uint8)
    result = to_array(make_message(make, fields, data, width=2, point_step=12))
    assert result.dtype.names == ("x",) and result["x"].tolist() == [1.5, 2.5]


@each_make
def test_field_count_of_zero_is_read_as_one(make):
    msg = make_message(make, [make_field(make, "x", 0, count=0)], np.zeros(4, np.uint8), point_step=4)
    assert compute_dtype(msg)["x"] == np.dtype("<f4")


@each_make
def test_arrays_of_a_cloud_are_read_only(make):
    cloud = to_array(from_array(np.zeros(3, XYZ), make_any_header(make), make))
    with pytest.raises(ValueError):
        cloud["x"] = 1


@each_make
@given(cloud=draw_points(), height=st.integers(1, 3), pad=st.integers(0, 9))
def test_add_columns_keeps_existing_bytes_and_fields(make, cloud, height, pad):
    cloud = repeat_cloud(cloud, height)
    step = cloud.dtype.itemsize
    old = make_padded_cloud(make, cloud, height, pad, unnamed=[0])
    new = add_columns(
        old, make, label=np.arange(len(cloud), dtype=np.uint16), score=np.linspace(0, 1, len(cloud), dtype=np.float32)
    )
    result = to_array(new)
    assert result.dtype.names == (*cloud.dtype.names, "label", "score")
    assert are_equal_arrays(result[list(cloud.dtype.names)], cloud)
    assert result["label"].tolist() == list(range(len(cloud)))
    assert result["score"].tolist() == np.linspace(0, 1, len(cloud), dtype=np.float32).tolist()
    raw = np.frombuffer(new.data, np.uint8).reshape(len(cloud), new.point_step)
    assert raw[:, :step].tobytes() == cloud.tobytes()
    assert list(new.fields[: len(old.fields)]) == list(old.fields)
    assert (new.height, new.width) == (old.height, old.width)
    assert (new.is_bigendian, new.is_dense) == (old.is_bigendian, old.is_dense)
    assert new.header == old.header
    assert all(f.offset % {4: 2, 7: 4}[f.datatype] == 0 for f in new.fields[-2:])


@each_make
@given(cloud=draw_points())
def test_last_of_two_equal_columns_is_used(make, cloud):
    first = np.arange(len(cloud), dtype=np.int32)
    once = add_columns(from_array(cloud, make_any_header(make), make), make, label=first)
    twice = add_columns(once, make, label=first[::-1])
    assert twice.point_step == once.point_step and list(twice.fields) == list(once.fields)
    assert to_array(twice)["label"].tolist() == first[::-1].tolist()
    assert are_equal_arrays(to_array(twice)[list(cloud.dtype.names)], cloud)


@each_make
@pytest.mark.parametrize("old", [("i", "<f4"), ("i", "<i4", (2,)), ("i", "<u4")])
@pytest.mark.parametrize("order", "<>")
def test_column_of_another_shape_or_type_is_replaced(make, old, order):
    dtype = np.dtype([("x", "<f4"), old, ("y", "<f8")]).newbyteorder(order)
    cloud = np.zeros(3, dtype)
    cloud["x"], cloud["y"] = [1, 2, 3], [4, 5, 6]
    result = to_array(
        add_columns(from_array(cloud, make_any_header(make), make), make, i=np.array([7, 8, 9], np.int32))
    )
    assert result.dtype["i"] == np.dtype(f"{order}i4") and result["i"].tolist() == [7, 8, 9]
    assert sorted(result.dtype.names) == ["i", "x", "y"]
    assert are_equal_arrays(result[["x", "y"]], cloud[["x", "y"]])


@each_make
def test_empty_cloud_stays_empty(make):
    empty = make_message(make, [], np.zeros(0, np.uint8), width=0, point_step=0)
    assert len(to_array(empty)) == 0
    result = to_array(add_columns(empty, make, label=np.zeros(0, np.uint8)))
    assert len(result) == 0 and result.dtype.names == ("label",)
    assert read_xyz(to_array(from_array(np.zeros(0, XYZ), make_any_header(make), make))).shape == (0, 3)


@each_make
@pytest.mark.parametrize("kind", ["<f4", ">f4", "<f8", ">f8"])
def test_xyz_reads_any_floating_point_cloud(make, kind):
    cloud = np.zeros(2, [("z", kind), ("ring", kind[0] + "u2"), ("y", kind), ("x", kind)])
    cloud["x"], cloud["y"], cloud["z"] = [1, np.nan], [3, np.inf], [5, 6]
    result = read_xyz(to_array(from_array(cloud, make_any_header(make), make)))
    assert result.dtype == np.float32 and result.flags.c_contiguous
    np.testing.assert_array_equal(result, [[1, 3, 5], [np.nan, np.inf, 6]])


def test_columns_are_returned_in_the_requested_order():
    cloud = np.arange(6, dtype="<f4").view(XYZ)
    assert read_columns(cloud, ("z", "x")).tolist() == [[2, 0], [5, 3]]


def test_xyz_beyond_float32_is_infinite_without_a_warning():
    assert np.isinf(read_xyz(np.array([(1e300, 0, 0)], [(n, "<f8") for n in "xyz"]))[0, 0])


@pytest.mark.parametrize(
    "dtype, words",
    [
        ([("y", "f4"), ("z", "f4")], "no field 'x'; it has y, z"),
        ([("x", "f4", (2,)), ("y", "f4"), ("z", "f4")], "field 'x' has count > 1"),
        ([("x", "i4"), ("y", "f4"), ("z", "f4")], "field 'x' has type int32"),
        ([("x", "f4"), ("y", "f4"), ("z", "u1")], "field 'z' has type uint8"),
    ],
)
def test_error_names_the_field_that_is_not_a_float(dtype, words):
    with pytest.raises(CloudError, match=words):
        read_xyz(np.zeros(2, dtype))


@each_make
@pytest.mark.parametrize("height, width", [(3, 1), (1, 3), (2, 3), (31, 16)])
@pytest.mark.parametrize("step", [lambda h, w: 0, lambda h, w: h * w * 8, lambda h, w: w * 8])
@pytest.mark.parametrize("more", [0, 4])
def test_row_step_of_0_or_of_the_whole_cloud_is_accepted(make, height, width, step, more):
    cloud = np.arange(height * width * 2, dtype="f4").view([("a", "f4"), ("b", "f4")])
    data = np.pad(cloud.view(np.uint8), (0, more))
    msg = make_message(
        make,
        make_point_fields(cloud.dtype, make),
        data,
        height=height,
        width=width,
        point_step=8,
        row_step=step(height, width),
    )
    assert are_equal_arrays(to_array(msg), cloud)
    wider = to_array(add_columns(msg, make, c=cloud["a"]))
    assert all(np.array_equal(wider[name], cloud[old]) for name, old in zip("abc", "aba"))


@each_make
@pytest.mark.parametrize(
    "change, words",
    [
        (dict(width=4), "data has 24 bytes, but height 1 x width 4 x point_step 8 requires 32"),
        (dict(height=2, width=2), "data has 24 bytes, but height 2 .* requires 32"),
        (dict(height=2, width=1, row_step=20), "data has 24 bytes.* requires 28"),
        (dict(height=3, width=1, row_step=7), "row_step = 7 is less than width x point_step = 8"),
        (dict(point_step=0), "point_step is 0 for 3 points"),
        (dict(point_step=6), "field 'b' at offset 4 extends beyond point_step = 6"),
        (dict(names="aa"), "field 'a' exists twice"),
        (dict(datatypes=(7, 9)), "field 'b' has datatype 9"),
        (dict(datatypes=(0, 7)), "field 'a' has datatype 0"),
        (dict(count=2), "field 'b' at offset 4 extends beyond point_step = 8"),
    ],
)
def test_error_names_the_broken_part_of_a_cloud(make, change, words):
    with pytest.raises(CloudError, match=words) as error:
        to_array(make_two_fields(make, **change))
    assert "\n" not in str(error.value)


@each_make
@pytest.mark.parametrize(
    "dtype", [[("x", "<f4"), ("y", ">f4")], [("x", "f2")], [("x", "i8")], [("x", "?")], [("x", "S4")]]
)
def test_types_unknown_to_point_cloud2_are_rejected(make, dtype):
    with pytest.raises(ValueError):
        from_array(np.zeros(2, dtype), make_any_header(make), make)


@each_make
def test_points_that_do_not_fill_the_rows_are_rejected(make):
    with pytest.raises(ValueError, match="5 points cannot be split into 2 rows"):
        from_array(np.zeros(5, XYZ), make_any_header(make), make, height=2)


@each_make
@pytest.mark.parametrize("height, width", [(1, 0), (0, 1), (0, 2**32 - 1), (1, 1)])
def test_huge_point_step_is_reported_with_and_without_points(make, height, width):
    fields = [make_field(make, name, 4 * i) for i, name in enumerate("xyz")]
    msg = make_message(
        make, fields, np.zeros(12, np.uint8), height=height, width=width, point_step=2**32 - 1, row_step=0
    )
    for read in (to_array, lambda m: add_columns(m, make, ground=np.zeros(0, "u1"))):
        with pytest.raises(CloudError, match="point_step is 4294967295"):
            read(msg)


@each_make
def test_columns_can_be_added_to_a_cloud_without_rows(make):
    fields = [make_field(make, name, 4 * i) for i, name in enumerate("xyz")]
    msg = make_message(make, fields, np.zeros(0, np.uint8), height=0, width=2**32 - 1, point_step=12, row_step=0)
    more = add_columns(msg, make, ground=np.zeros(0, "u1"))
    assert (more.row_step, more.width, len(to_array(more))) == (0, 2**32 - 1, 0)
