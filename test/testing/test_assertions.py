"""Assertions on detections: matching, messages, and bags of other programs."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest
from marker_messages import make_detection_markers
from samples import each_make, make_any_header, make_scene, make_walker_truth

from lidar_perception.data.bag import Bag
from lidar_perception.data.open import open_recording
from lidar_perception.nodes.graph import reserve_domain
from lidar_perception.testing.bags import make_frames
from lidar_perception.testing.clouds import make_cloud_message
from lidar_perception.testing.detections import assert_detections, to_objects
from lidar_perception.testing.launching import include_launch_file, make_description
from lidar_perception.types import CLASSES, Detections, GroundTruth, InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_truth_markers, to_point_cloud
from msg_utils.detections import to_detection_array
from msg_utils.point_cloud2 import to_array

NAMES = ("Car", "Pedestrian", "Cyclist")


def draw_objects(rng, count):
    boxes = np.column_stack(
        [
            rng.uniform(-30, 30, (count, 2)),
            rng.uniform(-2, 0, count),
            rng.uniform(0.5, 4, (count, 3)),
            rng.uniform(-3, 3, count),
        ]
    )
    return Detections.of(boxes, [CLASSES.index(n) for n in rng.choice(NAMES, count)], rng.uniform(0, 1, count))


def get_pairs(objects):
    return [(label, box) for label, box in zip(objects.labels, objects.boxes)]


@each_make
def test_every_type_of_detections_gives_the_same_message(make):
    found = draw_objects(np.random.default_rng(0), 7)
    expected = to_objects(found)
    truth = GroundTruth.of(found.boxes, found.class_ids)
    kinds = [
        make_detection_markers(found, make_any_header(make), make),
        make_truth_markers(truth, make_any_header(make), make),
        truth,
        expected,
        get_pairs(expected),
    ]
    if make is not make_bag_message and importlib.util.find_spec("vision_msgs"):
        kinds.append(
            to_detection_array(found.boxes, expected.labels, found.scores, header=make_any_header(make), make=make)
        )
    for kind in kinds:
        objects = to_objects(kind)
        assert objects.labels == expected.labels
        np.testing.assert_allclose(objects.boxes, expected.boxes, atol=1e-6)
        for limit in {"max_distance": 1e-3}, {"min_iou": 0.99}:
            assert assert_detections(kind, found, **limit) == [(i, i) for i in range(7)]


@pytest.mark.parametrize("limit", [{"max_distance": 0.5}, {"min_iou": 0.3}])
def test_order_does_not_matter_and_missing_detection_is_named(limit):
    """An object that is missing in one direction is unexpected in the other."""
    rng = np.random.default_rng(1)
    for _ in range(30):
        expected = draw_objects(rng, int(rng.integers(1, 20)))
        order = rng.permutation(len(expected))
        found = expected[order]
        assert sorted(assert_detections(found, expected, **limit)) == [(i, int(j)) for i, j in enumerate(order)]
        gone = int(rng.integers(len(found)))
        fewer = found[np.arange(len(found)) != gone]
        place = "at ({:.2f}, {:.2f}".format(*found.boxes[gone, :2])
        for a, b, word, allowed in (
            (fewer, expected, "missing", "max_missing"),
            (expected, fewer, "extra", "max_extra"),
        ):
            with pytest.raises(AssertionError) as error:
                assert_detections(a, b, **limit)
            lines = [line for line in str(error.value).splitlines()[1:]]
            assert len(lines) == 1 and f"{word}: " in lines[0] and place in lines[0]
            assert len(assert_detections(a, b, **limit, **{allowed: 1})) == len(fewer)


def test_matching_maximizes_pairs_of_equal_class():
    """Matching the first with its nearest would leave the second without a match."""
    found = [("Car", [0, 0, 0]), ("Car", [0.9, 0, 0])]
    assert assert_detections(found, [("Car", [0.8, 0, 0]), ("Car", [1.7, 0, 0])]) == [(0, 0), (1, 1)]
    cyclist = [("Cyclist", [0, 0, 0]), ("Car", [0.9, 0, 0])]
    with pytest.raises(AssertionError, match=r"missing: Car .*nearest: Cyclist, 0\.00 m"):
        assert_detections(cyclist, found)
    assert_detections(cyclist, found, same_class=False)
    assert_detections([], [])
    assert_detections(found, [], max_extra=None)


@pytest.mark.parametrize(
    "found, words",
    [
        (3, "int is not a MarkerArray"),
        ([("Car", [1, 2])], "list is not a MarkerArray"),
        (["Car"], "is not a MarkerArray"),
    ],
)
def test_invalid_detections_are_rejected(found, words):
    with pytest.raises(InputError, match=words):
        assert_detections(found, [])
    with pytest.raises(InputError, match="min_iou needs complete boxes"):
        assert_detections([], [("Car", [1, 2, 3])], min_iou=0.5)


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_arrays_survive_writing_to_a_bag(make_bag, storage):
    truths = [make_walker_truth(), None, [("Pedestrian", make_walker_truth().boxes[0])]]
    path = make_bag([make_scene(i) for i in range(3)], truths, storage=storage, points="/front", hz=5.0)
    assert [p.suffix for p in path.iterdir() if p.name != "metadata.yaml"] == [
        {"mcap": ".mcap", "sqlite3": ".db3"}[storage]
    ]
    with Bag(path) as bag:
        clouds = [to_point_cloud(m, 1.0)[0] for _, _, m in bag.messages({"/front"})]
    assert [np.array_equal(c.xyz, make_scene(i)[:, :3]) for i, c in enumerate(clouds)] == [True] * 3
    assert np.array_equal(clouds[0].intensity, make_scene(0)[:, 3])
    assert np.diff([c.stamp_ns for c in clouds]).tolist() == [2 * 10**8] * 2
    frames = open_recording(make_bag([make_scene(0)[:, :3]] * 3, truths, storage=storage))
    assert [frame.truth() is not None for frame in frames] == [True, False, True]
    np.testing.assert_allclose(frames.frames[2].truth().boxes, make_walker_truth().boxes)


@pytest.mark.parametrize(
    "clouds, labels, options, words",
    [
        ([np.zeros((5, 2))], None, {}, r"cloud 0 has shape \(5, 2\)"),
        ([make_scene()], [], {}, "1 clouds, but labels for 0"),
        ([make_scene()], [[("Dragon", [0] * 7)]], {}, "unknown class 'Dragon'; choose from Car"),
        ([make_scene()], [[("Car", [0] * 3)]], {}, "complete boxes"),
        ([make_scene()], None, {"storage": "tape"}, "unknown storage 'tape'; choose from mcap, sqlite3"),
        (make_frames([make_scene()]), [None], {"hz": 5.0}, "leave out labels and hz"),
    ],
)
def test_error_names_the_bag_that_cannot_be_written(make_bag, clouds, labels, options, words):
    with pytest.raises(InputError, match=words):
        make_bag(clouds, labels, **options)


def test_cloud_message_has_the_given_columns():
    ring = np.arange(3400, dtype=np.uint16) % 64
    points = to_array(make_cloud_message(make_scene(), 7, ring=ring))
    assert np.array_equal(points["ring"], ring) and points.dtype["ring"] == np.uint16
    assert np.array_equal(points["intensity"], make_scene()[:, 3])
    with pytest.raises(InputError, match=r"expected \(N, 3\)"):
        make_cloud_message(np.zeros(3))


def test_missing_launch_package_is_reported(monkeypatch):
    for module in ("launch", "launch.actions", "launch.launch_description", "launch_testing"):
        monkeypatch.setitem(__import__("sys").modules, module, None)
    for call in make_description, include_launch_file:
        with pytest.raises(InputError, match=r"launch.* is not installed; install ros-jazzy-"):
            call()


def test_reserved_domains_are_distinct():
    assert len({reserve_domain() for _ in range(5)}) == 5
