"""Whatever a foreign cloud holds in a column of ours: a result or a reason, and no more memory than
a good cloud takes. All nodes in this process, by their callbacks."""

from __future__ import annotations

import numpy as np
import pointnet_samples
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import lively, tiny

from lidar_perception.campaign.case import FAILED, REFUSED, Case
from lidar_perception.campaign.good import cloud
from lidar_perception.campaign.messages import TRIED, Tried
from lidar_perception.campaign.worker import memory_mb
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.nodes import NODES
from lidar_perception.nodes.watch import leave, new_context
from lidar_perception.wire.codec import bag_message, encode
from msg_utils.point_cloud2 import add_columns, to_array

COLUMNS = ("ground", "in_view", "cluster_id", "intensity")
LARGEST = {kind: np.iinfo(kind).max for kind in ("u1", "i2", "u4", "i4")} | {
    "f4": 3e38, "f8": 1e308}
OF_CLOUDS = [name for name, (_, inputs, _) in TRIED.items() if "input/points" in inputs]
MEGABYTES = 64.0  # a table with a byte for each number up to 2^31 has 2048


@pytest.fixture(scope="module")
def tried(domain, tmp_path_factory):
    """name -> the node; networks are small ones, as what they read is checked before them."""
    context, folder = new_context(domain), tmp_path_factory.mktemp("weights")
    pillars, clusters = str(folder / "v4.safetensors"), str(folder / "pointnet.safetensors")
    config = tiny("v4", low=(0.0, -10.24, -3.0), high=(20.48, 10.24, 1.0))
    save_checkpoint(pillars, lively(config), Header(config))
    config = pointnet_samples.small()
    save_checkpoint(clusters, pointnet_samples.lively(config), Header(config))
    values = {
        "pointpillars_detector": {"pointpillars.weights": pillars, "pointpillars.threads": 1},
        "pointnet_detector": {"pointnet.weights": clusters, "pointnet.threads": 1},
        "fused_detector": {"fused.weights": pillars, "fused.classifier": clusters,
                           "fused.threads": 1}}
    nodes = {name: Tried(name, context, **values.get(name, {})) for name in TRIED}
    yield nodes
    leave(context, *(each.node for each in nodes.values()))


def test_every_input_of_a_node_is_tried(tried):
    assert set(TRIED) == set(NODES) - {"bag_player", "bag_recorder"}
    for name, (_, inputs, _) in TRIED.items():
        assert set(inputs) == {topic for topic in tried[name].calls if "parameter" not in topic
                               and topic not in ("clock", "tf", "tf_static")}


def test_a_node_says_that_its_curves_are_of_other_weights(tried):
    fused = tried["fused_detector"].node
    assert "other weights than" in fused.counts["doubt"] == fused.detector.doubt


def outcome_of(node, name, message, then_good=False):
    """Of one cloud, with the node's first settings."""
    return node.attempt(Case("messages", name, 1, 0, {
        "topic": "input/points", "params": TRIED[name][2][0], "then_good": then_good},
        encode(message)))


@pytest.mark.parametrize("name", OF_CLOUDS)
@pytest.mark.no_cover
def test_no_value_of_a_column_costs_memory_or_goes_unchecked(tried, name):
    plain = cloud("columns")
    turn = np.arange(len(to_array(plain))) % 7
    assert outcome_of(tried[name], name, plain).reason == ""  # and what is needed is loaded
    for column in COLUMNS:
        for kind, largest in LARGEST.items():
            least = -largest if kind[0] in "if" else 0
            odd = np.nan if kind[0] == "f" else 2
            for values in (np.where(turn < 7, largest, 0),
                           np.choose(turn, [1, largest, least, odd, largest, 0, 1])):
                message = add_columns(plain, bag_message, **{column: values.astype(kind)})
                before = memory_mb("VmRSS", reset=True)
                outcome = outcome_of(tried[name], name, message)
                case = column, kind, values[:7].tolist(), outcome.reason
                assert outcome.verdict != FAILED, case
                assert memory_mb("VmHWM") - before < MEGABYTES, case
    assert outcome_of(tried[name], name, message, then_good=True).verdict != FAILED


@pytest.mark.parametrize("column", ["ground", "in_view", "cluster_id"])
def test_a_column_of_several_numbers_a_point_is_refused(tried, column):
    plain = cloud("columns")
    plain.fields = [f for f in plain.fields if f.name in ("x", "y", "z", column)]
    plain.fields[-1].offset, plain.fields[-1].datatype, plain.fields[-1].count = 12, 2, 2  # uint8
    verdicts = {name: outcome_of(tried[name], name, plain) for name in OF_CLOUDS}
    reading = {"ground": {"clustering"}, "in_view": set(OF_CLOUDS),
               "cluster_id": {"candidate_refinement", "pointnet_detector"}}[column]
    for name, outcome in verdicts.items():
        assert outcome.verdict != FAILED, (name, outcome)
        if name in reading:
            assert outcome.verdict == REFUSED and "count > 1" in outcome.reason, (name, outcome)
