"""The evaluator node: late, lost and repeated messages, other frames, and all classes."""

from __future__ import annotations

import json

import numpy as np
import pytest
from marker_messages import make_detection_markers

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from tracking_samples import START, TENTH, make_crowd_detections

from lidar_perception.camera import Calibration
from lidar_perception.nodes.replay.evaluator import MAX_INCOMPLETE_FRAMES, Evaluator
from lidar_perception.types import CLASSES, Detections, InputError
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import make_camera_info, make_extrinsics
from lidar_perception.wire.topics import CAMERA_FRAME
from msg_utils.stamps import make_header


def make_detections(number, frame_id="lidar"):
    return make_detection_markers(
        next(make_crowd_detections()), make_header(START + number * TENTH, frame_id, make_bag_message), make_bag_message
    )


def list_problems(node):
    return " ".join(message for _, _, message in node.problems())


@pytest.mark.parametrize("late", [0, MAX_INCOMPLETE_FRAMES - 1, MAX_INCOMPLETE_FRAMES + 30])
def test_late_labels_are_scored_and_lost_frames_counted_once(start_node, late):
    node, count = start_node(Evaluator), 300
    for i in range(count + late):
        if i < count:
            node._add("final", make_detections(i))
        if i >= late:
            node._add("ground_truth", make_detections(i - late))
    given_up = count - MAX_INCOMPLETE_FRAMES if late > MAX_INCOMPLETE_FRAMES else 0
    assert node.diagnostics.counts["frames"] == count - given_up
    assert node.diagnostics.counts["incomplete"] + len(node.incomplete_frames) == given_up


def test_detections_wait_for_their_labels_up_to_a_limit(start_node):
    node = start_node(Evaluator)
    for name in "final", "ground_truth":
        for i in range(MAX_INCOMPLETE_FRAMES + 30):
            node._add(name, make_detections(i))
    assert node.diagnostics.counts["frames"] == MAX_INCOMPLETE_FRAMES and node.diagnostics.counts["incomplete"] == 30
    assert not node.incomplete_frames and node.diagnostics.counts["repeated"] == 30
    assert node.diagnostics.state[1] == "scoring"


def test_file_error_is_reported_and_writing_retried(start_node, tmp_path):
    folder = tmp_path / "scores"
    with pytest.raises(InputError, match="give the path of a file"):
        start_node(Evaluator, file=str(tmp_path))
    node = start_node(Evaluator, file=str(folder / "scores.json"))
    node._add_time("detector", float("nan"))
    folder.write_text("a file where the folder should be")
    node.write()
    assert "cannot write" in list_problems(node) and "retrying" in list_problems(node)
    with pytest.raises(InputError, match="the scores are lost"):
        node.close()
    folder.unlink()
    node.close()
    assert list_problems(node) == "" and json.loads((folder / "scores.json").read_text())


def test_boxes_in_other_frames_are_scored_with_a_warning(start_node):
    node = start_node(Evaluator)
    node._add("ground_truth", make_detections(0, "velo"))
    node._add("final", make_detections(0, "odom"))
    assert node.diagnostics.counts["frames"] == 1
    for words in "ground_truth in 'velo'", "final in 'odom'":
        assert words in list_problems(node)
    node._add("ground_truth", make_detections(1))
    node._add("final", make_detections(1))
    assert list_problems(node) == "" and np.isfinite(float(node.diagnostics.counts["F1 of final"]))


def make_objects(stamp, cars=(), cyclists=(), pedestrians=()):
    """Return markers of objects at the given distances ahead, each 2 m further to the left."""
    rows = [
        [x, 2.0 * i, -0.9, *size, 0.0, CLASSES.index(name)]
        for name, size, found in (
            ("Car", (4, 2, 1.5), cars),
            ("Cyclist", (1.8, 0.6, 1.7), cyclists),
            ("Pedestrian", (0.8, 0.6, 1.7), pedestrians),
        )
        for i, x in enumerate(found)
    ]
    boxes = np.array(rows, float).reshape(-1, 8)
    return make_detection_markers(
        Detections.of(boxes[:, :7], boxes[:, 7].astype(int), np.full(len(boxes), 0.9)),
        make_header(stamp, "lidar", make_bag_message),
        make_bag_message,
    )


@pytest.mark.parametrize("with_camera", [False, True])
def test_all_classes_are_scored_and_ap_at_the_end(with_camera, start_node, tmp_path):
    file = tmp_path / "scores.json"
    node = start_node(Evaluator, file=str(file))
    if with_camera:
        camera = Calibration(
            np.array([[700.0, 0, 600, 0], [0, 700, 180, 0], [0, 0, 1, 0]]),
            np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]),
            1200,
            370,
        )
        header = make_header(0, CAMERA_FRAME, make_bag_message)
        node._on_camera("camera_info", make_camera_info(camera, header, make_bag_message))
        extrinsics = make_extrinsics(camera, make_header(0, "lidar", make_bag_message), make_bag_message)
        node._on_camera("extrinsics", extrinsics)
        first = node._read_calibration()
        assert node._read_calibration() is first  # it is not read for every frame
        node._on_camera("extrinsics", extrinsics)
        assert node._read_calibration() is not first
    frames = [  # labels and detections
        (dict(cars=[20, -20], pedestrians=[10]), dict(cars=[20, -30], pedestrians=[10, 30])),
        (dict(cars=[15], cyclists=[12]), dict(cars=[15], pedestrians=[9])),
        (dict(pedestrians=[8]), dict(pedestrians=[8], cyclists=[14])),
    ]
    for i, (truth, found) in enumerate(frames):
        node._add("ground_truth", make_objects(START + i, **truth))
        node._add("final", make_objects(START + i, **found))
    node.close()
    content = json.loads(file.read_text())

    def counts(result):
        row = result["final"]["all"]
        return result["frames"], row["tp"], row["fp"], row["fn"]

    behind = int(not with_camera)  # the car behind is outside the image
    assert counts(content) == (2, 2, 1, 0)  # the frame without pedestrians is not scored
    assert counts(content["classes"]["Car"]) == (3, 2, behind, behind)
    assert counts(content["classes"]["Cyclist"]) == (3, 0, 1, 1)
    assert content["ap"]["final"]["Pedestrian"]["3d"]["easy"]["r40"] == 50
    assert ("image" in content["ap"]["final"]["Car"]) == with_camera
    assert node.diagnostics.counts["F1 of final, Car"] == ("1.000" if with_camera else "0.667")


@pytest.mark.parametrize(
    "values, words",
    [
        ({"classes": ["Cart"]}, "unknown class 'Cart'; did you mean 'Car'"),
        ({"stages": ["ground_truth"]}, "must be distinct names"),
        ({"stages": ["a", "a"]}, "must be distinct names"),
        ({"timing": ["foo"]}, "does not have the form"),
    ],
)
def test_unusable_parameters_are_rejected(start_node, values, words):
    with pytest.raises(InputError, match=words):
        start_node(Evaluator, **values)
