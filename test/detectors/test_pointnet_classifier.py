"""PointNet classifies boxes of another detector by the points in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from candidate_samples import make_boxes_at, make_people_scene
from pointnet_samples import make_random_detector

from lidar_perception.detectors.pointnet.classifier import BOX_MARGIN_M
from lidar_perception.detectors.pointnet.clusters import crop_boxes
from lidar_perception.detectors.pointnet.predict import predict
from lidar_perception.geometry import points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, PointCloud

pytestmark = pytest.mark.usefixtures("one_thread")

CAR, VAN = CLASSES.index("Car"), CLASSES.index("Van")


@pytest.fixture(scope="module")
def frame():
    xyz = make_people_scene()
    return PointCloud(xyz, np.random.default_rng(1).uniform(0, 1, len(xyz)).astype(np.float32))


@pytest.fixture
def proposals():
    """Return boxes around two people and a post, and one without points."""
    boxes = make_boxes_at([(7, 2), (12, -5), (10.95, 9.5), (30, 30)])
    boxes[2, 3:6] = 2.5, 3.5, 1.6
    return Detections.of(boxes, [PEDESTRIAN, CAR, CAR, PEDESTRIAN], [0.9, 0.8, 0.5, 0.4])


def test_points_in_each_box_form_a_cluster(frame, proposals):
    clusters = crop_boxes(proposals.boxes, frame, 0.2)
    assert len(clusters) == len(proposals) and clusters.sizes[3] < 5 < clusters.sizes[:3].min()
    for i, box in enumerate(proposals.boxes):
        points, in_box = clusters.points[clusters.first[i] : clusters.first[i + 1]], points_in_box(frame.xyz, box, 0.2)
        np.testing.assert_array_equal(points[:, :3], frame.xyz[in_box])
        np.testing.assert_array_equal(points[:, 3], frame.intensity[in_box])
    clusters_without_intensity = crop_boxes(proposals.boxes, replace(frame, intensity=None), 0.2)
    assert (
        not clusters_without_intensity.points[:, 3].any() and (clusters_without_intensity.first == clusters.first).all()
    )
    assert len(crop_boxes(proposals.boxes[:0], frame, 0.2)) == 0


def test_proposals_are_classified_independently(frame, proposals):
    classifier, ground = make_random_detector().classifier, np.zeros((0, 3), np.float32)
    mask = np.ones(len(proposals), bool)
    probabilities, boxes = classifier.classify(proposals, frame, ground, mask)
    predictions = predict(classifier.network, crop_boxes(proposals.boxes[:3], frame, BOX_MARGIN_M))
    columns = [classifier.classes.index(CLASSES[i]) for i in proposals.class_ids[:3]]
    np.testing.assert_allclose(probabilities[:3], predictions.probabilities[np.arange(3), columns], atol=1e-6)
    reversed_results = classifier.classify(proposals[::-1], frame, ground, mask)
    np.testing.assert_allclose(reversed_results[0], probabilities[::-1], atol=1e-5)
    np.testing.assert_allclose(reversed_results[1], boxes[::-1], atol=1e-4)
    assert [len(a) for a in classifier.classify(proposals[:0], frame, ground, mask[:0])] == [0, 0]


def test_classifier_skips_unknown_classes_and_empty_boxes(frame, proposals):
    proposals.class_ids[1] = VAN
    mask = np.array([True, True, False, True])
    for values in make_random_detector().classifier.classify(proposals, frame, frame.xyz[:0], mask):
        is_classified = np.isfinite(values.reshape(4, -1)).all(axis=1)
        assert is_classified.tolist() == [True, False, False, False]
