"""The evaluator between nodes that are late, elsewhere, or two."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from tracking_samples import START, TENTH, crowd

from lidar_perception.nodes.replay.evaluator import MAX_INCOMPLETE_FRAMES, Evaluator
from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import make_detection_markers
from msg_utils.stamps import make_header


def array(number, frame_id="lidar"):
    return make_detection_markers(next(crowd()), make_header(START + number * TENTH, frame_id,
                                                             bag_message), bag_message)


def said(node):
    return " ".join(message for _, _, message in node.problems())


@pytest.mark.parametrize("late", [0, MAX_INCOMPLETE_FRAMES - 1, MAX_INCOMPLETE_FRAMES + 30])
def test_labels_may_be_late_and_lost_frames_count_once(start, late):
    node, count = start(Evaluator), 300
    for i in range(count + late):
        if i < count:
            node._add("final", array(i))
        if i >= late:
            node._add("ground_truth", array(i - late))
    given_up = count - MAX_INCOMPLETE_FRAMES if late > MAX_INCOMPLETE_FRAMES else 0
    assert node.counts["frames"] == count - given_up
    assert node.counts["incomplete"] + len(node.waiting) == given_up


def test_all_detections_before_all_labels_leave_those_that_wait(start):
    node = start(Evaluator)
    for name in "final", "ground_truth":
        for i in range(MAX_INCOMPLETE_FRAMES + 30):
            node._add(name, array(i))
    assert node.counts["frames"] == MAX_INCOMPLETE_FRAMES and node.counts["incomplete"] == 30
    assert not node.waiting and node.counts["repeated"] == 30
    assert "nothing on /evaluator/input/ground_truth with their" in node.state[1] or (
        node.state[1] == "scoring")


def test_a_file_that_cannot_be_written_is_said_and_tried_again(start, tmp_path):
    folder = tmp_path / "scores"
    with pytest.raises(InputError, match="give the path of a file"):
        start(Evaluator, file=str(tmp_path))
    node = start(Evaluator, file=str(folder / "scores.json"))
    node._add_time("detector", float("nan"))
    folder.write_text("a file where the folder should be")
    node.write()
    assert "cannot write" in said(node) and "retrying" in said(node)
    with pytest.raises(InputError, match="the scores are lost"):
        node.close()
    folder.unlink()
    node.close()
    assert said(node) == "" and json.loads((folder / "scores.json").read_text())


def test_boxes_of_other_frames_are_scored_and_said(start):
    node = start(Evaluator)
    node._add("ground_truth", array(0, "velo"))
    node._add("final", array(0, "odom"))
    assert node.counts["frames"] == 1
    assert "ground_truth in 'velo'" in said(node) and "final in 'odom'" in said(node)
    node._add("ground_truth", array(1))
    node._add("final", array(1))
    assert said(node) == "" and np.isfinite(float(node.counts["F1 of final"]))


@pytest.mark.parametrize("values, words", [
    ({"stages": ["ground_truth"]}, "must be distinct names"),
    ({"stages": ["a", "a"]}, "must be distinct names"),
    ({"timing": ["foo"]}, "not of the form")])
def test_parameters_with_which_nothing_is_scored_are_refused(start, values, words):
    with pytest.raises(InputError, match=words):
        start(Evaluator, **values)
