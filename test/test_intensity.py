"""Scale of intensities, and arrays instead of a PointCloud."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lidar_perception.candidates.pipeline import segment_cloud
from lidar_perception.clustering.cluster import cluster, cluster_obstacles
from lidar_perception.ground.params import GroundParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.intensity import (
    REFERENCE_LEVELS,
    REFERENCE_VALUES,
    StreamScale,
    find_scale_problem,
    guess_scale,
    infer_full_scale,
    normalize_intensity,
    to_unit,
)
from lidar_perception.nodes.sensor_check import SensorCheck
from lidar_perception.robot.params import CropParams
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.types import Detections, InputError, PointCloud
from lidar_perception.wire.params import InputParams

UNIT = np.random.default_rng(0).uniform(0, 1, 3000).astype(np.float32) ** 3
UNIT[0] = 1.0
WHOLE = {full: np.round(UNIT * full) for full in (100, 255, 1023, 4095, 65535)}


@pytest.mark.parametrize(
    "values, kind, full",
    [
        (UNIT, "f4", 1),
        (UNIT * 1.4, "f4", 1),
        (UNIT * 100, "f4", 100),
        (UNIT * 255, "f8", 255),
        (WHOLE[100], "f4", 255),  # Velodyne: diffuse surfaces up to 100, retroreflectors beyond
        (WHOLE[255], "f4", 255),
        (WHOLE[1023], "f4", 1023),
        (WHOLE[4095], "f4", 4095),
        (WHOLE[65535], "f8", 65535),
        (UNIT * 1e9, "f8", 65535),
        (UNIT, "u1", 255),
        (WHOLE[255], "u1", 255),
        (WHOLE[100] // 2, "i1", 127),
        (WHOLE[255], "u2", 255),
        (WHOLE[1023], "u2", 1023),
        (WHOLE[4095], "u2", 4095),
        (WHOLE[65535], "u2", 65535),
        (WHOLE[65535], "u4", 65535),
        (UNIT, "i4", 255),
        (UNIT * 0, "f4", 1),
        (UNIT * 0 + 7, "f4", 255),
        ([], "f4", 1),
        ([], "u1", 255),
        ([np.nan, np.inf, -5, 0.5], "f4", 1),
        ([np.nan] * 3, "f4", 1),
        (-UNIT, "f4", 1),
    ],
)
def test_full_scale_depends_on_values_and_type(values, kind, full):
    values = np.asarray(values)
    assert infer_full_scale(values.astype(kind)) == full
    if np.isfinite(values).all():
        assert infer_full_scale(values.astype(kind).astype(np.float32), kind) == full


def test_few_invalid_values_do_not_change_the_scale():
    many = np.tile(UNIT, 10)
    many[:2] = 1e30, 40000.0
    assert infer_full_scale(many) == 1.0 and find_scale_problem(many) is None
    many[:30] = 255.0
    assert infer_full_scale(many) == 255.0


def test_to_unit_keeps_regular_values_and_zeroes_invalid_ones():
    assert to_unit(UNIT, 1.0).tobytes() == UNIT.tobytes()
    values = to_unit(np.array([np.nan, np.inf, -np.inf, -3, 1e300, 0, 51, 510]), 255)
    assert values.dtype == np.float32 and np.allclose(values, [0, 0, 0, 0, 0, 0, 0.2, 2])


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 0, 1], [1, 2, 0]])
def test_scale_of_a_stream_never_decreases(order):
    clouds = [UNIT, WHOLE[255], np.float32([0, 1, 1.2])]
    scale = StreamScale()
    found = [scale(clouds[i]) for i in order]
    assert found == sorted(found) and scale.full_scale == 255.0


def test_dark_clouds_use_the_scale_of_their_stream():
    """The scale of one node does not affect another node."""

    def message(values, stamp):
        return make_cloud_message(np.column_stack([np.ones((len(values), 3)), values]), stamp)

    params = SimpleNamespace(input=InputParams(), crop=CropParams(), ground=GroundParams())
    placement = SimpleNamespace(level_frame=lambda frame: frame)
    transforms = SimpleNamespace(
        find_placement=lambda header: placement, with_mounting=lambda params, placement: params
    )
    node = SimpleNamespace(params=params, transforms=transforms, diagnostics=SimpleNamespace(counts={}))
    check, other = SensorCheck(node), SensorCheck(node)
    bright, dark = WHOLE[255], np.float32([0, 1, 1])
    assert np.array_equal(check.read_frame(message(bright, 1), True)[0].intensity, bright / np.float32(255))
    assert np.array_equal(check.read_frame(message(dark, 2), True)[0].intensity, dark / np.float32(255))
    assert np.array_equal(other.read_frame(message(dark, 2), True)[0].intensity, dark)
    node.params.input = InputParams(intensity_max=2.0)
    assert np.array_equal(check.read_frame(message(dark, 3), True)[0].intensity, dark / 2)
    assert check.read_frame(message(dark, 4))[0].intensity is None  # nobody uses the intensity


@pytest.mark.parametrize("full", [100, 255, 1023, 4095, 65535])
def test_wrong_scale_is_reported_with_remedy(full):
    values = UNIT * np.float32(full)
    assert guess_scale(values) == full
    problem = find_scale_problem(values)
    assert "input.intensity_max" in problem and f"full scale of {full} is assumed" in problem
    assert "PointCloud.of" in problem and "\n" not in problem


def test_dark_intensities_are_reported():
    assert "highest intensity is 0.02," in find_scale_problem(UNIT * np.float32(0.02))
    assert find_scale_problem(UNIT[:100] * np.float32(0.02)) is None
    for fine in (None, UNIT, UNIT * 0, UNIT[:0], np.full(3000, 0.3)):
        assert find_scale_problem(fine) is None


@pytest.mark.parametrize(
    "change", [lambda x: 0.1 * x, lambda x: 255 * x, lambda x: x**2.2, lambda x: np.round(x * 255)]
)
def test_normalized_intensity_ignores_gain_and_gamma(change):
    rng = np.random.default_rng(2)
    intensity = rng.beta(2, 5, 20_000).astype(np.float32)
    intensity[::10] = 0
    normalized = normalize_intensity(intensity)
    np.testing.assert_allclose(normalize_intensity(change(intensity)), normalized, atol=0.02)
    assert (normalized[::10] == 0).all() and normalized.dtype == np.float32
    np.testing.assert_array_equal(normalize_intensity(intensity, np.arange(7, 900)), normalized[7:900])
    positive = normalized[normalized > 0]
    np.testing.assert_allclose(np.quantile(positive, REFERENCE_LEVELS), REFERENCE_VALUES, atol=0.02)


def test_unusable_intensity_is_normalized_to_none():
    few = np.where(np.arange(1000) % 20, 0, 0.5)
    same = np.where(np.arange(1000) % 20, 0.5, 0.7)
    for intensity in (None, few, same, np.zeros(9), np.zeros(0), np.full(9, np.nan)):
        assert normalize_intensity(intensity) is None


# arrays

CLOUD = np.random.default_rng(1).uniform([2, -9, -2, 0], [30, 9, 1, 1], (400, 4))


@pytest.mark.parametrize(
    "points, remedy",
    [
        (np.ones((9, 5)), r"shape \(9, 5\).*points\[:, :4\]"),
        (np.ones((9, 2)), r"shape \(9, 2\)"),
        (np.ones((4, 90)), r"points\.T"),
        (np.ones((3, 90)), r"points\.T"),
        (np.ones(9), r"\(9,\)"),
        (np.ones((2, 9, 3)), r"\(2, 9, 3\)"),
        (np.ones((9, 3), object), "ndarray of object"),
        (np.ones((9, 3), bool), "ndarray of bool"),
        (np.ones((9, 3), complex), "complex"),
        (np.ones(9, [("x", "f4"), ("y", "f4")]), "ndarray of void"),
        ([[1, 2, 3], [1]], "to an array"),
        ("drive.bag", "type str"),
        (None, "type NoneType"),
        (7.0, r"shape \(\)"),
    ],
)
def test_every_entry_point_rejects_invalid_clouds(points, remedy):
    for function in (PointCloud.of, segment_ground, cluster, lambda cloud: cluster_obstacles(cloud, np.zeros(9, bool))):
        with pytest.raises(InputError, match=f"a cloud .*{remedy}") as error:
            function(points)
        assert r"(N, 3) [x y z]" in str(error.value) and "\n" not in str(error.value)


def test_every_form_of_a_cloud_gives_an_equal_frame():
    plain = PointCloud.of(CLOUD[:, :3])
    four = PointCloud.of(CLOUD, stamp_ns=5, frame_id="velodyne")
    assert plain.intensity is None and (four.stamp_ns, four.frame_id) == (5, "velodyne")
    for same in (
        PointCloud.of(CLOUD.tolist()),
        PointCloud.of(CLOUD[:, :3], CLOUD[:, 3]),
        PointCloud.of(CLOUD[:, :3], list(CLOUD[:, 3])),
        PointCloud.of(CLOUD.copy("F")),
    ):
        assert np.array_equal(same.xyz, plain.xyz) and np.array_equal(same.intensity, four.intensity)
        assert same.xyz.flags.c_contiguous and same.intensity.dtype == np.float32
    whole = PointCloud.of(np.int64([[5, 0, -1], [0, 0, 0]]))
    assert whole.xyz.tolist() == [[5, 0, -1]]
    for empty in ([], np.zeros((0, 3)), np.zeros((0, 4)), np.full((5, 4), np.nan)):
        assert len(PointCloud.of(empty)) == 0


def test_intensity_scale_is_declared_or_inferred_from_the_type():
    raw = (CLOUD[:, 3] * 255).astype(np.uint8)
    expected = raw / np.float32(255)
    xyz = CLOUD[:, :3]
    for frame in (
        PointCloud.of(xyz, raw),
        PointCloud.of(xyz, raw.astype(float), intensity_max=255),
        PointCloud.of(np.column_stack([xyz, raw]), intensity_max=255),
    ):
        assert np.array_equal(frame.intensity, expected)
    intensity = PointCloud.of(xyz[:3], [np.nan, -1, 0.5]).intensity
    assert intensity.tolist() == [0, 0, 0.5]
    for wrong, said in (
        (dict(intensity=raw[:9]), r"\(9,\) for 400 points"),
        (dict(intensity=raw[:, None]), r"\(400, 1\) for 400"),
        (dict(intensity=["a"] * 400), "intensity has type list"),
        (dict(intensity_max=0.0), "intensity_max is 0"),
        (dict(intensity_max=np.nan), "intensity_max is nan"),
    ):
        with pytest.raises(InputError, match=said):
            PointCloud.of(xyz, **wrong)
    with pytest.raises(InputError, match="intensity is given both"):
        PointCloud.of(CLOUD, raw)
    with pytest.raises(InputError, match=r"shape \(400, 4\), expected \(N, 3\); PointCloud.of"):
        PointCloud(CLOUD)


@pytest.mark.parametrize("method", ["threshold", "patchwork", "cloth"])
def test_ground_of_an_array_equals_that_of_its_frame(method):
    params = GroundParams(method=method)
    xyz = np.random.default_rng(2).uniform([3, -9, -1.75], [30, 9, -1.7], (2000, 3))
    cloud = np.column_stack([xyz, UNIT[:2000]]).astype(np.float32)
    expected = segment_ground(PointCloud.of(cloud), params)
    assert expected.any() and np.array_equal(segment_ground(cloud, params), expected)
    cloud[7] = np.nan
    found = segment_ground(cloud, params)
    assert found.shape == (2000,) and not found[7]
    bright = segment_ground(np.column_stack([xyz, UNIT[:2000] * 255]), params)
    assert np.array_equal(
        bright, segment_ground(PointCloud.of(np.column_stack([xyz, UNIT[:2000] * 255]), intensity_max=255), params)
    )


def test_clusters_of_an_array_equal_those_of_its_frame():
    ids = cluster(PointCloud.of(CLOUD))
    assert np.array_equal(cluster(CLOUD), ids) and np.array_equal(cluster(CLOUD[:, :3]), ids)
    with pytest.raises(InputError, match="ground has 3 values for 400 points"):
        cluster_obstacles(CLOUD, np.zeros(3, bool))
    with pytest.raises(InputError, match="cluster_ids has 3 values for 400 points"):
        segment_cloud(CLOUD, cluster_ids=np.zeros(3, int))
    expected = segment_cloud(PointCloud.of(CLOUD))
    for same in (segment_cloud(CLOUD), segment_cloud(CLOUD.tolist(), ground=expected.ground.tolist())):
        assert np.array_equal(same.cluster_ids, expected.cluster_ids)


@pytest.mark.parametrize(
    "boxes, said",
    [
        (np.ones((7, 2)), r"\(7, 2\)"),
        (np.ones((2, 8)), r"\(2, 8\)"),
        (np.ones(14), r"\(14,\)"),
        (np.ones((1, 2, 7)), r"\(1, 2, 7\)"),
        ("box", "type str"),
    ],
)
def test_boxes_of_wrong_shape_are_rejected(boxes, said):
    with pytest.raises(InputError, match=f"boxes .*{said}"):
        Detections.of(boxes)


def test_error_of_the_tracker_names_the_expected_type():
    for wrong in (np.ones((2, 7)), None):
        with pytest.raises(InputError, match=rf"not {type(wrong).__name__}; pass detector"):
            Tracker()(wrong)
    with pytest.raises(InputError, match=r"scores have shape \(3,\) for 2 boxes"):
        Detections.of(np.ones((2, 7)), 1, [1, 1, 1])
    assert len(Detections.of([])) == 0 and len(Detections.of(np.ones(7))) == 1
