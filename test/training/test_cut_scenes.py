"""Clusters of labelled scenes: cutting, augmentation, learning and scoring."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pointnet_samples import SMALL, make_blobs, make_classifier
from samples import CALIBRATION

from lidar_perception.data.frame import Frame
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.pointnet.clusters import Clusters
from lidar_perception.detectors.pointnet.config import make_pointnet_config
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.network import PointNet
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams
from lidar_perception.detectors.pointnet.predict import Predictions
from lidar_perception.geometry import points_in_box, wrap_angle
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.points.clusters import (
    UNKNOWN,
    ClusterScores,
    count_confusions,
    find_unlabelled,
    label_clusters,
    label_points,
    set_unlabelled_to_unknown,
)
from lidar_perception.training.augment import TrainingScene, raise_scene
from lidar_perception.training.data import SceneReader
from lidar_perception.training.params import ClusterAugmentParams
from lidar_perception.training.pointnet import cut_scenes
from lidar_perception.training.pointnet.cut_scenes import SPARSE_FRACTIONS, CutScene, CutScenes, cut_clusters
from lidar_perception.training.pointnet.task import (
    MIN_POINTS_LEFT,
    ClusterPreparation,
    augment_clusters,
    load_validation_clusters,
    make_loss,
    validate_network,
)
from lidar_perception.types import CLASSES, SENSOR_HEIGHT, Detections, GroundTruth, InputError, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread")
CONFIG = make_pointnet_config(**SMALL)
STILL = ClusterAugmentParams(
    box_shift=0,
    farther=0,
    dropout=0,
    beam_noise=0,
    range_noise=0,
    scale=0,
    flip=0,
    intensity=0,
    no_intensity=0,
    fade=0,
    quantize=0,
    speckle=0,
    height=0,
    things_stretch=0,
    things_intensity=0,
    things_shine=0,
)


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def to_class_ids(*names):
    return np.array([CLASSES.index(name) for name in names])


def fill_boxes(rng, boxes, count=60):
    """Return clusters of points that fill boxes."""
    parts = []
    for box in boxes:
        unit = rng.uniform(-0.49, 0.49, (count, 3)) * box[3:6]
        cos, sin = np.cos(box[6]), np.sin(box[6])
        rotated_points = np.column_stack(
            [cos * unit[:, 0] - sin * unit[:, 1], sin * unit[:, 0] + cos * unit[:, 1], unit[:, 2]]
        )
        parts.append(np.column_stack([rotated_points + box[:3], rng.random(count)]))
    points = np.concatenate(parts).astype(np.float32)
    return Clusters(points, np.arange(len(boxes) + 1) * count, np.arange(1, len(boxes) + 1))


BOXES = np.array(
    [
        [10, 2, -0.9, 4, 1.7, 1.5, 0.4],
        [8, -6, -0.85, 0.7, 0.7, 1.75, 0],
        [15, 5, -0.85, 1.8, 0.7, 1.75, 2.0],
        [20, -9, -0.4, 5, 2, 2.5, -1],
    ]
)


def test_cluster_gets_label_of_most_of_its_points(rng):
    names = to_class_ids("Car", "Pedestrian", "Cyclist", "Van")
    clusters = fill_boxes(rng, np.concatenate([BOXES, BOXES[:1] + [40, 0, 0, 0, 0, 0, 0]]))
    labels, owners = label_clusters(clusters, BOXES, names, CONFIG.classes)
    assert labels.tolist() == [0, 1, 2, UNKNOWN, 3] and owners.tolist() == [0, 1, 2, -1, -1]
    # with a third of its points in the box a cluster is unknown, with a tenth it is background
    for share, expected in ((0.9, 0), (0.3, UNKNOWN), (0.1, 3)):
        points = clusters.points[:60].copy()
        points[int(60 * share) :, 2] += 5
        one = Clusters(points, np.array([0, 60]), np.array([1]))
        assert label_clusters(one, BOXES, names, CONFIG.classes)[0].tolist() == [expected]
    none = label_clusters(clusters, np.zeros((0, 7)), to_class_ids(), CONFIG.classes)
    assert none[0].tolist() == [3] * 5 and none[1].tolist() == [-1] * 5
    points = label_points(clusters.points[:, :3], BOXES, names, CONFIG.classes)
    assert points.reshape(5, 60).tolist() == [[k] * 60 for k in (0, 1, 2, UNKNOWN, 3)]


def test_background_in_unlabelled_regions_is_unknown(rng):
    camera = CALIBRATION.camera()
    xyz = np.column_stack([rng.uniform(-20, 40, 500), rng.uniform(-20, 20, (500, 2))])
    xyz = xyz.astype(np.float32)
    whole = np.array([0, 0, camera.width, camera.height])
    assert np.array_equal(camera.in_regions(xyz, whole[None]), camera.in_view(xyz))
    halves = np.array([[0, 0, 600, camera.height], [600, 0, camera.width, camera.height]])
    assert np.array_equal(camera.in_regions(xyz, halves), camera.in_view(xyz))
    assert not camera.in_regions(xyz, np.zeros((0, 4))).any()
    clusters = fill_boxes(rng, BOXES[:3], 10)
    truth = GroundTruth.of(np.zeros((0, 7)), [], notes=(("DontCare", {"bbox": whole}),))
    blind = find_unlabelled(truth, camera, clusters.points[:, :3])
    assert blind.all() and not find_unlabelled(replace(truth, notes=()), camera, clusters.points[:, :3]).any()
    blind[:14] = False  # the first cluster, and 40 % of the second
    assert set_unlabelled_to_unknown(np.array([3, 3, 3]), clusters, blind, 3).tolist() == [3, UNKNOWN, UNKNOWN]
    assert set_unlabelled_to_unknown(np.array([0, 1, 2]), clusters, blind, 3).tolist() == [0, 1, 2]


def test_cluster_and_point_scores_agree_with_hand_count(rng):
    scores = ClusterScores(CONFIG.classes)
    clusters = make_blobs(rng, [20, 20, 12, 12, 9])
    found = np.eye(4, dtype=np.float32)[[0, 3, 1, 2, 0]]
    labels = np.array([0, 0, 1, 3, 0])  # correct, missed, correct, wrong, and too small to count
    numbers = np.array([1, 1, 2, 3, 0, 0])
    truth = np.array([0, 3, 0, 1, 1, UNKNOWN])
    scores.update(
        count_confusions(
            clusters, labels, Predictions(found, found.argmax(1), np.zeros((5, 7))), truth, numbers, CONFIG.classes
        )
    )
    content = scores.compute()
    assert content["clusters"]["accuracy"] == 50.0
    assert content["clusters"]["object_accuracy"] == pytest.approx(200 / 3)
    car = content["clusters"]["by_class"]["Car"]
    assert (car["objects"], car["precision"], car["recall"]) == (2, 100.0, 50.0)
    assert content["clusters"]["by_class"]["Cyclist"]["recall"] is None
    car = content["points"]["by_class"]["Car"]  # one of two is detected, and one detection is wrong
    assert (car["precision"], car["recall"], car["f1"], car["iou"]) == (50.0, 50.0, 50.0, pytest.approx(100 / 3))
    assert content["points"]["mean"]["recall"] == 50.0
    empty = ClusterScores(CONFIG.classes).compute()
    assert empty["clusters"]["accuracy"] is None and empty["points"]["mean"]["iou"] is None


def test_augmented_clusters_stay_in_boxes_and_thin_with_range(rng):
    clusters = fill_boxes(rng, BOXES, 400)
    no = np.zeros(4, bool)
    same, boxes = augment_clusters(clusters, BOXES, no, STILL, rng)
    assert np.allclose(same.points, clusters.points, atol=1e-6) and np.allclose(boxes, BOXES)
    for seed in range(5):
        params = ClusterAugmentParams(beam_noise=0, range_noise=0, intensity=0)
        augmented, boxes = augment_clusters(clusters, BOXES, no, params, np.random.default_rng(seed))
        for k in range(4):
            own = augmented.points[augmented.first[k] : augmented.first[k + 1], :3]
            assert len(own) >= MIN_POINTS_LEFT and points_in_box(own, boxes[k], 1e-3).all()
        # objects that are moved away keep their direction and have fewer points
        ratio = np.hypot(*boxes[:, :2].T) / np.hypot(*BOXES[:, :2].T)
        assert np.allclose(
            np.abs(np.arctan2(boxes[:, 1], boxes[:, 0])), np.abs(np.arctan2(BOXES[:, 1], BOXES[:, 0])), atol=0.03
        )
        far = ratio > 1.3
        assert (augmented.sizes[far] < 400 / ratio[far] ** 2 + 60).all()
    flip = ClusterAugmentParams(**{**vars(STILL), "flip": 1.0})
    twice = augment_clusters(*augment_clusters(clusters, BOXES, no, flip, rng), no, flip, rng)
    assert np.allclose(twice[0].points, clusters.points, atol=1e-6)
    assert np.allclose(wrap_angle(twice[1] - BOXES), 0, atol=1e-6)


def test_box_crops_are_near_their_boxes_and_never_empty(rng):
    clusters = fill_boxes(rng, BOXES * [1, 1, 1, 1.4, 1.4, 1.4, 1], 300)
    augmented, boxes = augment_clusters(clusters, BOXES, np.ones(4, bool), STILL, rng)
    assert np.allclose(boxes, BOXES) and (augmented.sizes < 300).all() and (augmented.sizes > 80).all()
    tiny = fill_boxes(rng, BOXES, 3)
    hard = ClusterAugmentParams(dropout=0.99, box_shift=2.0)
    assert (augment_clusters(tiny, BOXES, np.ones(4, bool), hard, rng)[0].sizes == 3).all()


def make_scene(rng):
    """Return a car, a pedestrian and an unwanted cyclist on flat ground."""
    flat = np.column_stack([rng.uniform(-20, 30, (12_000, 2)), rng.normal(-1.73, 0.01, 12_000), rng.random(12_000)])
    points = np.concatenate([flat, fill_boxes(rng, BOXES[:3], 500).points]).astype(np.float32)
    return TrainingScene(points, BOXES[:3], to_class_ids("Car", "Pedestrian", "Cyclist"), np.array([True, True, False]))


@dataclass(frozen=True)
class RepeatedScene:
    """Scene source that repeats one scene."""

    one: TrainingScene
    count: int = 1

    def __len__(self):
        return self.count

    def cache_key(self, i):
        return "one"

    def load_scene(self, i):
        return self.one


def test_scene_is_cut_by_clustering_and_around_objects(rng, tmp_path):
    scene = make_scene(rng)
    clusters = cut_clusters(scene, CONFIG, 5)
    assert set(clusters.labels[~clusters.is_box_crop]) == {0, 1, UNKNOWN}  # the cyclist is not detectable
    assert clusters.labels[clusters.is_box_crop].tolist() == [0, 1]
    assert np.array_equal(clusters.boxes[clusters.is_box_crop], BOXES[:2])
    assert not clusters.boxes[clusters.labels == UNKNOWN].any() and clusters.boxes[clusters.labels == 1].any()
    source = CutScenes(RepeatedScene(scene), CONFIG, 5, tmp_path)
    first, second = source.load_scene(0), source.load_scene(0)  # the second one is read from the cache
    assert len(list(tmp_path.iterdir())) == 1
    for name in ("labels", "boxes", "is_box_crop"):
        assert np.array_equal(getattr(first, name), getattr(second, name))
    assert np.array_equal(first.clusters.points, second.clusters.points)
    next(tmp_path.iterdir()).write_bytes(b"broken")
    assert np.array_equal(source.load_scene(0).labels, first.labels)
    other = CutScenes(RepeatedScene(scene), make_pointnet_config("base"), 5, tmp_path)
    other.load_scene(0)
    assert len(list(tmp_path.iterdir())) == 2  # another configuration has its own cache file


def test_clusters_equal_those_of_detector_at_scene_height(rng):
    seen = make_scene(rng)
    small_boxes = BOXES[:3] * [1, -1, 1, 0.1, 0.3, 0.3, 0]  # some are too small
    things = fill_boxes(rng, small_boxes, 6).points
    points = np.concatenate([seen.points, things])
    scene = raise_scene(replace(seen, points=points, height=3.5), SENSOR_HEIGHT - 3.5)
    classifier = make_classifier(PointNet(CONFIG), Header(CONFIG), "torch")
    read = []
    classifier.network.network.register_forward_pre_hook(lambda _, inputs: read.append(len(inputs[0])))
    detector = PointNetDetector(
        classifier,
        with_values(
            PointNetDetectorParams(ground=CONFIG.ground, clustering=CONFIG.clustering),
            {"ground.sensor_pose.height": scene.height, "pointnet.min_points": 5},
        ),
    )
    detector(PointCloud(scene.points[:, :3].copy(), scene.points[:, 3].copy()))
    clusters = cut_clusters(scene, CONFIG, 5)
    assert sum(read) == (~clusters.is_box_crop).sum() > 3


def test_fraction_of_sparse_scenes_is_reproducible(rng, tmp_path):
    scene, count = make_scene(rng), 40
    none, half, all_ = (
        CutScenes(RepeatedScene(scene, count), CONFIG, 5, tmp_path, sparse=sparse) for sparse in (0.0, 0.5, 1.0)
    )
    assert {none.draw_fraction(i) for i in range(count)} == {1.0}
    assert all(SPARSE_FRACTIONS[0] <= all_.draw_fraction(i) <= SPARSE_FRACTIONS[1] for i in range(count))
    shares = [half.draw_fraction(i) for i in range(count)]
    assert 10 < sum(share < 1 for share in shares) < 30
    assert all(share in (1.0, all_.draw_fraction(i)) for i, share in enumerate(shares))
    whole, known = none.load_scene(0), set(map(bytes, scene.points[:, :3]))
    sizes = []
    for i in range(count):
        thinned, second = all_.load_scene(i), all_.load_scene(i)  # the second one is read from the cache
        assert np.array_equal(thinned.clusters.points, second.clusters.points)
        assert known >= set(map(bytes, thinned.clusters.points[:, :3]))
        sizes.append(thinned.clusters.sizes[(thinned.labels == 0) & thinned.is_box_crop][0])
    car = whole.clusters.sizes[(whole.labels == 0) & whole.is_box_crop][0]
    expected = np.array([all_.draw_fraction(i) for i in range(count)]) * car
    assert (np.abs(sizes - expected) < 5 * np.sqrt(expected)).all()


def test_wrong_proposals_away_from_labels_become_decoys(rng, tmp_path, monkeypatch):
    flat = np.column_stack([rng.uniform(-20, 30, (12_000, 2)), rng.normal(-1.73, 0.01, 12_000), rng.random(12_000)])
    empty = BOXES[0] + [8, 8, 0, 0, 0, 0, 0]
    points = np.concatenate([flat, fill_boxes(rng, np.array([BOXES[0], empty]), 500).points])
    scene = TrainingScene(points.astype(np.float32), BOXES[:1], to_class_ids("Car"), np.array([True]))
    near = BOXES[0] + [1, 0.5, 0, 0, 0, 0, 0.2]
    found = Detections.of(np.array([near, empty]), to_class_ids("Car", "Pedestrian"), np.array([0.9, 0.5]))
    monkeypatch.setattr(
        cut_scenes, "_load_proposer", lambda path: SimpleNamespace(propose=lambda frame: DetectionResult(found))
    )
    plain, cut = (cut_clusters(scene, CONFIG, 5, path) for path in (None, tmp_path))
    none = len(CONFIG.classes)
    boxes = cut.boxes[cut.is_box_crop & (cut.labels == none)]
    assert [np.isclose(boxes, box, atol=1e-5).all(axis=1).sum() for box in (empty, near)] == [1, 0]
    assert np.array_equal(cut.labels[~cut.is_box_crop], plain.labels[~plain.is_box_crop])
    assert (cut.labels[cut.is_box_crop] < none).sum() == 1


def test_half_of_the_background_samples_are_decoys(rng):
    scene = sample_scene(rng)
    background = np.flatnonzero(scene.labels == 3)
    for decoys in (0, 4, 30):
        is_box_crop = np.isin(np.arange(len(scene.labels)), background[:decoys])
        judge = ClusterPreparation(CONFIG, ClusterAugmentParams(background=20), True)
        drawn_rows = judge._draw_clusters(replace(scene, is_box_crop=is_box_crop), rng)
        assert (scene.labels[drawn_rows] == 3).sum() == 20
        assert is_box_crop[drawn_rows].sum() == min(decoys, 10)


def sample_scene(rng, count=40):
    clusters = fill_boxes(
        rng,
        np.tile(BOXES[:3], (count, 1)) + np.repeat(rng.uniform(-1, 1, (count, 7)) * [3, 3, 0, 0, 0, 0, 0], 3, axis=0),
        20,
    )
    labels = np.tile([0, 1, 3], count)
    boxes = np.tile(BOXES[:3], (count, 1)) * (labels < 3)[:, None]
    return CutScene(clusters, labels, boxes, np.zeros(len(labels), bool))


def test_sampling_limits_each_class_and_drops_unknown(rng):
    scene = sample_scene(rng)
    scene.labels[:3] = UNKNOWN
    params = ClusterAugmentParams(objects=7, background=5)
    sample = ClusterPreparation(CONFIG, params)(scene, rng)
    assert np.bincount(sample.labels, minlength=4).tolist() == [7, 7, 0, 5]
    assert np.array_equal(sample.has_box, sample.labels < 3)
    nothing = CutScene(scene.clusters, np.full(len(scene.labels), UNKNOWN), scene.boxes, scene.is_box_crop)
    with pytest.raises(InputError, match="no cluster"):
        ClusterPreparation(CONFIG, params)(nothing, rng)


def test_only_background_gets_high_intensity(rng):
    scene = sample_scene(rng)
    scene.clusters.points[:, 3] = 0.3
    before = scene.clusters.points.copy()
    for shine in (0.0, 1.0):
        sample = ClusterPreparation(CONFIG, replace(STILL, things_shine=shine))(scene, rng)
        bright = (sample.inputs.points[..., 3] > 0.9).any(axis=1)
        assert not bright[sample.has_box].any()
        # not all clusters, because some have no point between the heights
        assert bright[~sample.has_box].mean() >= 0.7 * shine
        assert shine or not bright.any()
    assert np.array_equal(scene.clusters.points, before)


def test_network_learns_to_classify_clusters(rng):
    torch.manual_seed(0)
    network, loss = PointNet(CONFIG), make_loss(CONFIG, torch.device("cpu"))
    optimizer = torch.optim.Adam(network.parameters(), 0.01)
    prepare = ClusterPreparation(CONFIG, STILL)
    first = None
    for _ in range(60):
        total, parts = loss(network, [prepare(sample_scene(rng, 8), rng)])
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        first = first or parts["classes"].item()
    assert parts["classes"].item() < 0.5 * first


def test_validation_calibrates_and_reports_broken_scenes(rng):
    scene = sample_scene(rng, 4)
    truth = GroundTruth.of(
        BOXES[:3], to_class_ids("Car", "Pedestrian", "Cyclist"), [{"truncated": 0.0, "occluded": 0}] * 3
    )

    class Source:
        def __len__(self):
            return 2

        def load_scene(self, i):
            if i == 1:
                raise InputError("broken.bin")
            return scene

        def load_frame(self, i):
            return Frame.of("a", PointCloud(np.zeros((0, 3), np.float32)), truth, CALIBRATION)

    items = [SceneReader((Source(),), load_validation_clusters)[n] for n in range(2)]
    assert items[1].sample is None and items[1].skipped == ("broken.bin",)
    torch.manual_seed(0)
    network = PointNet(CONFIG).eval()
    metrics, calibration = validate_network(network, [items[0].sample])
    assert calibration == {}  # one scene is not enough to fit
    assert {"score", "accuracy", "object_accuracy", "calibration_error"} <= set(metrics)
    assert 0 <= metrics["accuracy"] <= 100 and network.temperature.item() != 1.0
