"""The nodes as real processes over DDS, compared with the offline path on the same bag."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from ros_samples import PAPER

from lidar_perception.candidates.pipeline import find_candidates
from lidar_perception.data.bag import Bag
from lidar_perception.data.open import open_recording
from lidar_perception.nodes.graph import find_result_cloud_topic, list_result_topics
from lidar_perception.nodes.replay.graph_replay import replay
from lidar_perception.param_fields import with_values
from lidar_perception.scoring.centres.report import CandidateReport, make_seed_source, measure_frame, select_pedestrians
from lidar_perception.testing.processes import NodesUnderTest
from lidar_perception.wire.messages import read_column, to_detections, to_point_cloud
from lidar_perception.wire.topics import POINTS
from msg_utils.markers import from_marker_array
from msg_utils.point_cloud2 import to_array

PAPER_C = {"ground.method": "cloth", "clustering.method": "euclidean", "boxes.shape": "l_shape"}
RUNS = {  # single process, processes, parameters in addition to PAPER
    "three nodes of paper C": (False, True, PAPER_C),
    "the same in one process, automatic seed": (False, False, {**PAPER_C, "seed.source": "automatic"}),
    "one node, patchwork": (
        True,
        True,
        {"ground.method": "patchwork", "boxes.shape": "min_area", "clustering.dbscan.join_bands": True},
    ),
}


@pytest.fixture(scope="module", params=RUNS.values(), ids=RUNS)
def graph_setting(request):
    single, processes, values = request.param
    return single, processes, with_values(PAPER, values)


@pytest.fixture(scope="module")
def graph_run(graph_setting, drive_bag, tmp_path_factory):
    """One replay: whether it is a single process, its scores, and the folder of the result bag."""
    single, processes, params = graph_setting
    out = tmp_path_factory.mktemp("run")
    with Bag(drive_bag) as bag, pytest.MonkeyPatch.context() as patch:
        clouds = bag.counts[POINTS]
        patch.setattr("lidar_perception.nodes.replay.graph_replay.Processes", NodesUnderTest)
        return single, replay(drive_bag, clouds, out, params, single=single, processes=processes), out


@pytest.fixture(scope="module")
def offline_results(graph_setting, drive_bag):
    """Candidates of the offline pipeline by stamp, and its report."""
    report, results, params = CandidateReport(), {}, graph_setting[-1]
    for frame in open_recording(drive_bag):
        people = select_pedestrians(frame.truth())
        if len(people):
            report.update(measure_frame(frame, params))
            results[frame.stamp_ns] = find_candidates(
                frame.load(), make_seed_source(people, None, params), frame.camera(), params
            )
    return results, report


def test_no_frame_is_lost_between_processes(graph_run):
    _, content, _ = graph_run
    assert content["results"] == content["clouds"] == content["frames"]
    assert content["lost_frames"] == 0


def test_candidates_over_dds_equal_offline_candidates(graph_run, offline_results):
    single, _, out = graph_run
    for stage, topic in list_result_topics(single).items():
        with Bag(out / "result") as bag:
            messages = [from_marker_array(m) for _, _, m in bag.messages({topic})]
        received = {m.stamp_ns: to_detections(m) for m in messages}
        assert received.keys() == offline_results[0].keys()
        assert any(len(d) for d in received.values())
        for stamp, detections in received.items():
            expected = getattr(offline_results[0][stamp][1], stage)
            np.testing.assert_array_equal(detections.boxes, expected.boxes)
            np.testing.assert_array_equal(detections.scores, expected.scores)
            np.testing.assert_array_equal(detections.class_ids, expected.class_ids)


def test_published_cloud_has_all_fields_and_offline_columns(graph_run, offline_results, drive_bag):
    single, _, out = graph_run
    with Bag(drive_bag) as bag:
        sent = {to_point_cloud(m)[0].stamp_ns: m for _, _, m in bag.messages({POINTS})}
    with Bag(out / "result") as bag:
        clouds = [m for _, _, m in bag.messages({find_result_cloud_topic(single)})]
    assert len(clouds) == len(sent)
    for msg in clouds:
        frame, indices = to_point_cloud(msg)
        original = to_array(sent[frame.stamp_ns])
        for name in original.dtype.names:
            np.testing.assert_array_equal(to_array(msg)[name], original[name])
        segmented, _ = offline_results[0][frame.stamp_ns]
        np.testing.assert_array_equal(indices, segmented.indices)
        np.testing.assert_array_equal(read_column(msg, "ground", indices) > 0, segmented.ground)
        np.testing.assert_array_equal(read_column(msg, "cluster_id", indices), segmented.cluster_ids)
        assert msg.header.frame_id == "velodyne"


def test_evaluator_scores_equal_offline_scores(graph_run, offline_results):
    _, content, out = graph_run
    expected = json.loads(json.dumps(offline_results[1].compute()))
    for key in ("frames", "ground_truth", "ground_truth_by_range", "stage1", "stage2", "final"):
        assert _round_values(content[key]) == _round_values(expected[key])
    assert json.loads((out / "logs" / "scores.json").read_text())["frames"] == expected["frames"]


def _round_values(value):
    if isinstance(value, dict):
        return {k: _round_values(v) for k, v in value.items()}
    return round(value, 6) if isinstance(value, float) else value
