"""The cluster network judges boxes of another detector by the points in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from candidate_samples import boxes_at, scene
from pointnet_samples import random_detector

from lidar_perception.detectors.pointnet.clusters import points_of
from lidar_perception.detectors.pointnet.predict import predict
from lidar_perception.detectors.pointnet.rescoring import class_probabilities, known
from lidar_perception.geometry import points_in_box
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, LidarFrame

pytestmark = pytest.mark.usefixtures("one_thread")

CAR, VAN = CLASSES.index("Car"), CLASSES.index("Van")


@pytest.fixture(scope="module")
def frame():
    xyz = scene()
    return LidarFrame(xyz, np.random.default_rng(1).uniform(0, 1, len(xyz)).astype(np.float32))


@pytest.fixture(scope="module")
def proposals():
    """Return boxes on two people and a thing, and one without points."""
    boxes = boxes_at([(7, 2), (12, -5), (10.95, 9.5), (30, 30)])
    boxes[2, 3:6] = 2.5, 3.5, 1.6
    return Detections.of(boxes, [PEDESTRIAN, CAR, CAR, PEDESTRIAN], [0.9, 0.8, 0.5, 0.4])


def test_clusters_are_the_points_in_each_box(frame, proposals):
    made = points_of(proposals.boxes, frame, 0.2)
    assert len(made) == len(proposals) and made.sizes[3] < 5 < made.sizes[:3].min()
    for i, box in enumerate(proposals.boxes):
        part, inside = made.points[made.first[i]:made.first[i + 1]], points_in_box(
            frame.xyz, box, 0.2)
        np.testing.assert_array_equal(part[:, :3], frame.xyz[inside])
        np.testing.assert_array_equal(part[:, 3], frame.intensity[inside])
    dark = points_of(proposals.boxes, replace(frame, intensity=None), 0.2)
    assert not dark.points[:, 3].any() and (dark.first == made.first).all()
    assert len(points_of(proposals.boxes[:0], frame, 0.2)) == 0


def test_each_proposal_is_judged_by_itself(frame, proposals):
    classifier, asked = random_detector(), np.arange(3)
    clusters = points_of(proposals.boxes, frame, 0.2)
    scores, boxes = class_probabilities(classifier, proposals[asked], clusters.take(asked))
    network = predict(classifier.network, clusters.take(asked))
    columns = [classifier.config.classes.index(CLASSES[i]) for i in proposals.class_ids[asked]]
    np.testing.assert_allclose(scores, network.probabilities[asked, columns], atol=1e-6)
    turned = asked[::-1]
    again = class_probabilities(classifier, proposals[turned], clusters.take(turned))
    np.testing.assert_allclose(again[0], scores[::-1], atol=1e-5)
    np.testing.assert_allclose(again[1], boxes[::-1], atol=1e-4)
    assert scores.dtype == boxes.dtype == np.float32
    assert [len(a) for a in class_probabilities(classifier, proposals[:0], clusters.take(asked[:0]))
            ] == [0, 0]


def test_a_network_knows_its_own_classes():
    known_to = known(random_detector(), np.array([PEDESTRIAN, VAN, CAR]))
    assert known_to.tolist() == [True, False, True]
