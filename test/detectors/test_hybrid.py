"""The hybrid detectors: each box is scored by itself, from what both parts say of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from candidate_samples import boxes_at, scene
from detection_samples import same
from pointnet_samples import random_detector

from lidar_perception.candidates.configurations import BEST
from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.candidates.seed_sources import automatic_seed
from lidar_perception.candidates.seeds import load_seed
from lidar_perception.detectors.contract import Found
from lidar_perception.detectors.fused.evidence import LEAST, MOST
from lidar_perception.detectors.hybrid.candidates import RescoredCandidates
from lidar_perception.detectors.hybrid.params import ConfirmingParams, RescoringParams
from lidar_perception.detectors.hybrid.proposals import ConfirmedProposals
from lidar_perception.detectors.pointnet.clusters import clusters_of, points_of
from lidar_perception.detectors.pointnet.predict import predict
from lidar_perception.detectors.pointnet.rescoring import combined, rescored_by
from lidar_perception.geometry import bev_iou, points_in_box
from lidar_perception.param_fields import with_values
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, InputError, LidarFrame

pytestmark = pytest.mark.usefixtures("one_thread")

PIPELINE = with_values(BEST, {"view.enabled": False, "height.tolerance": 1.0})
SEED = automatic_seed(load_seed(), PIPELINE)
CAR, VAN = CLASSES.index("Car"), CLASSES.index("Van")


def cloud() -> LidarFrame:
    xyz = scene()
    return LidarFrame(xyz, np.random.default_rng(1).uniform(0, 1, len(xyz)).astype(np.float32))


@pytest.fixture(scope="module")
def classifier():
    return random_detector()


@pytest.fixture(scope="module")
def found(classifier):
    """What a low threshold leaves: the frame's segmentation and candidates."""
    pipeline = RescoredCandidates(classifier, SEED, None, RescoringParams(min_confidence=0.0),
                                  PIPELINE).pipeline
    segmented, candidates = find_candidates(cloud(), SEED, None, pipeline)
    assert len(candidates.final) >= 4
    return segmented, candidates


@pytest.fixture(scope="module")
def clusters(found):
    segmented, candidates = found
    ids = np.where(np.isin(segmented.cluster_ids, candidates.clusters), segmented.cluster_ids, 0)
    return clusters_of(cloud().take(segmented.indices), ids, ground=segmented.ground)


def rescored(classifier, **changes) -> Detections:
    params = RescoringParams(**{"min_confidence": 0.0, "threshold": 0.0, **changes})
    return RescoredCandidates(classifier, SEED, None, params, PIPELINE)(cloud()).detections


def test_the_combined_score_is_a_mean_and_each_alone_at_its_ends():
    rng = np.random.default_rng(0)
    a, b = rng.uniform(0, 1, (2, 100)).astype(np.float32)
    a[0] = b[1] = 0
    np.testing.assert_array_equal(combined(a, b, 0.0), a)
    np.testing.assert_array_equal(combined(a, b, 1.0), b)
    for weight in (0.2, 0.5, 0.9):
        mean = combined(a, b, weight)
        assert (mean >= np.minimum(a, b) - 1e-6).all() and (mean <= np.maximum(a, b) + 1e-6).all()
        np.testing.assert_allclose(mean, combined(b, a, 1 - weight), rtol=1e-5)
        assert mean[0] == mean[1] == 0


def test_candidates_know_their_clusters(found):
    segmented, candidates = found
    np.testing.assert_array_equal(segmented.boxes[candidates.clusters - 1],
                                  candidates.final.boxes)
    assert (np.diff(candidates.clusters) > 0).all()


def test_the_candidates_stand_where_they_did_and_say_what_both_parts_think(classifier, found,
                                                                           clusters):
    place = classifier.config.classes.index("Pedestrian")
    judged = predict(classifier.network, clusters).probabilities[:, place].astype(float)
    shaped = found[1].final.scores.astype(float)
    result = rescored(classifier, box="cluster")
    assert set(result.sources) == {"silhouette", "classifier"} and len(result) == len(judged)
    for k, box in enumerate(result.boxes):
        i = np.flatnonzero((found[1].final.boxes == box).all(axis=1))[0]
        assert result.sources["silhouette"][k] == pytest.approx(
            np.clip(shaped[i], LEAST, MOST), abs=1e-6)
        assert result.sources["classifier"][k] == pytest.approx(
            np.clip(judged[i], LEAST, MOST), abs=1e-5)
    # What both think more likely of one candidate than of another is.
    said = np.stack([*result.sources.values()])
    surer = (said[:, :, None] >= said[:, None, :]).all(axis=0)
    assert (result.scores[:, None] - result.scores[None] >= -1e-6)[surer].all()


def test_a_candidate_is_scored_by_itself_whatever_the_order(classifier, found, clusters):
    whole, boxes = rescored_by(classifier, found[1].final, clusters, 0.5)
    order = np.random.default_rng(2).permutation(len(whole))[:-1]
    part, part_boxes = rescored_by(classifier, found[1].final[order], clusters.take(order), 0.5)
    assert same(part, whole[order], atol=1e-5)
    np.testing.assert_allclose(part_boxes, boxes[order], atol=1e-4)


def test_boxes_of_the_network_are_of_pedestrians_and_do_not_overlap(classifier, found, clusters):
    result = rescored(classifier, overlap=0.1)
    _, boxes = rescored_by(classifier, found[1].final, clusters, 0.5)
    assert all((np.abs(boxes - box).max(axis=1) < 1e-4).any() for box in result.boxes)
    overlap = bev_iou(result.boxes, result.boxes) - np.eye(len(result))
    assert overlap.max() <= 0.1 and (result.class_ids == PEDESTRIAN).all()
    assert (np.diff(result.scores) <= 0).all()


def test_the_threshold_leaves_what_scores_as_much(classifier):
    everything = rescored(classifier, box="cluster")
    limit = float(np.median(everything.scores))
    assert same(rescored(classifier, box="cluster", threshold=limit),
                everything[everything.scores >= limit])


def test_times_and_problems_are_told(classifier):
    detector = RescoredCandidates(classifier, SEED, pipeline=PIPELINE)
    found = detector(cloud())
    assert found.problem is None and {"clustering", "stm", "network"} <= {*found.ms}
    nothing = detector(LidarFrame(np.zeros((0, 3), np.float32)))
    assert len(nothing.detections) == 0 and "empty" in nothing.problem
    with pytest.raises(InputError, match="no camera calibration"):
        RescoredCandidates(classifier, SEED)(cloud())


def test_the_numbers_of_a_clouds_clusters_may_have_gaps(classifier, found):
    segmented, _ = found
    ground, ids = np.zeros((2, len(cloud())), np.int64)
    ground[segmented.indices], ids[segmented.indices] = segmented.ground, segmented.cluster_ids
    detector = RescoredCandidates(classifier, SEED, None, RescoringParams(threshold=0.0), PIPELINE)
    wanted = detector(cloud()).detections
    for other in (ids, np.where(ids > 0, ids + 1, 0), 1000 * ids):
        assert same(detector(cloud(), ground=ground.astype(bool), cluster_ids=other).detections,
                    wanted)


def test_a_network_that_knows_no_pedestrian_cannot_score_candidates():
    with pytest.raises(InputError, match="not know the class Pedestrian, only Car"):
        RescoredCandidates(random_detector(classes=("Car",), sizes=((4, 2, 1.5),)), SEED)


@pytest.fixture(scope="module")
def proposals():
    """On two people and a thing, one nowhere, and one of a class that the network does not know."""
    boxes = np.concatenate([boxes_at([(7, 2), (12, -5), (10.95, 9.5), (30, 30), (7, 2)])])
    boxes[2, 3:6] = 2.5, 3.5, 1.6
    return Detections.of(boxes, [PEDESTRIAN, CAR, CAR, PEDESTRIAN, VAN], [0.9, 0.8, 0.5, 0.4, 0.35])


def confirmed(classifier, proposals, frame=None, **changes) -> Detections:
    def proposer(frame, **columns) -> Found:
        return Found(proposals, problem="as the proposer says")
    detector = ConfirmedProposals(proposer, classifier, ConfirmingParams(**{"threshold": 0.0,
                                                                       **changes}))
    found = detector(cloud() if frame is None else frame)
    assert found.problem == "as the proposer says"
    assert {*found.ms} == {"proposals", "ground", "clusters", "network"}
    return found.detections


def test_with_weight_0_the_proposals_stand_as_they_are(classifier, proposals):
    assert same(confirmed(classifier, proposals, weight=0.0), proposals)
    assert len(confirmed(classifier, proposals[:0])) == 0


def test_with_weight_1_those_with_points_get_the_networks_probability(classifier, proposals):
    result = confirmed(classifier, proposals, weight=1.0)
    assert (np.diff(result.scores) <= 0).all() and len(result) == len(proposals)
    score_of = {tuple(box) + (kind,): score for box, kind, score in zip(
        result.boxes.tolist(), result.class_ids, result.scores)}
    scores = [score_of[(*box, kind)] for box, kind in zip(proposals.boxes.tolist(),
                                                          proposals.class_ids)]
    np.testing.assert_array_equal(scores[3:], proposals.scores[3:])  # no points, no such class
    assert (np.abs(np.array(scores[:3]) - proposals.scores[:3]) > 1e-3).all()
    for i in range(3):
        alone = confirmed(classifier, proposals[i:i + 1], weight=1.0)
        assert alone.scores[0] == pytest.approx(scores[i], abs=1e-6)


def test_few_points_say_nothing(classifier, proposals):
    assert same(confirmed(classifier, proposals, min_points=1_000_000), proposals)


def test_a_higher_sensor_sees_the_same(classifier, proposals):
    frame, lift = cloud(), np.float32(0.5)
    low = confirmed(classifier, proposals, frame)
    higher = random_detector(with_values(classifier.params, {
        "ground.sensor_pose.height": classifier.params.ground.sensor_pose.height + float(lift)}))
    down = np.array([0, 0, -lift], np.float32)
    boxes = proposals.boxes + np.pad(down, (0, 4))
    high = confirmed(higher, replace(proposals, boxes=boxes),
                     replace(frame, xyz=frame.xyz + down))
    np.testing.assert_allclose(high.scores, low.scores, atol=2e-3)


def test_the_points_of_boxes_are_those_within(proposals):
    frame = cloud()
    seen = replace(frame, xyz=frame.xyz + np.float32(1))
    made = points_of(proposals.boxes, frame, seen, 0.2)
    assert len(made) == len(proposals) and made.sizes[3] < 5 < made.sizes[:3].min()
    for i, box in enumerate(proposals.boxes):
        part = made.points[made.first[i]:made.first[i + 1]]
        inside = points_in_box(frame.xyz, box, 0.2)
        np.testing.assert_array_equal(part[:, :3], seen.xyz[inside])
        np.testing.assert_array_equal(part[:, 3], seen.intensity[inside])
    assert len(points_of(proposals.boxes[:0], frame, seen, 0.2)) == 0
