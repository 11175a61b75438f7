"""The command evaluate segmentation, and SemanticKITTI folders."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from click.testing import CliRunner
from samples import DATA, make_lowered_crowd, make_walker_label, needs_data, write_file, write_object_folder

from lidar_perception.candidates.refine import STAGES
from lidar_perception.cli.evaluate.candidates import candidates
from lidar_perception.cli.evaluate.segmentation import segmentation
from lidar_perception.clustering.params import CLUSTERING_METHODS
from lidar_perception.data.open import open_recording
from lidar_perception.data.semantickitti import GROUND
from lidar_perception.data.to_bag import write_bag
from lidar_perception.ground.params import GROUND_METHODS
from lidar_perception.scoring.points.segmentation import find_instances
from lidar_perception.types import InputError


def write_semantic_folder(root, scans=("00/000000", "00/000001", "05/000000")):
    """A road 1.73 m below, two cars of 200 points, some unusable returns."""
    rng = np.random.default_rng(0)
    road = rng.uniform(-20, 20, (4000, 3)) * [1, 1, 0.001] - [0, 0, 1.73]
    car = rng.uniform(-1, 1, (200, 3)) * [0.15, 0.15, 0.3] - [0, 0, 0.9]
    xyz = np.concatenate([road, car + [8, 3, 0], car + [9, -4, 0], [[0, 0, 0], [np.nan, 1, 1]]])
    cloud = np.column_stack([xyz, np.full(len(xyz), 0.4)]).astype(np.float32)
    labels = np.repeat(np.array([40, 10 | 7 << 16, 252 | 300 << 16, 0], np.uint32), [4000, 200, 200, 2])
    for name in scans:
        sequence, scan = name.split("/")
        write_file(root / f"sequences/{sequence}/velodyne/{scan}.bin", cloud.tobytes())
        write_file(root / f"sequences/{sequence}/labels/{scan}.label", labels.tobytes())
    return root


def test_folder_is_read_in_order_without_unusable_returns(tmp_path):
    write_semantic_folder(tmp_path / "dataset")
    write_file(tmp_path / "dataset/sequences/11/velodyne/000000.bin", b"")  # a test sequence
    frames = open_recording(tmp_path).frames
    assert [f.name for f in frames] == ["00/000000", "00/000001", "05/000000"]
    assert [f.name for f in open_recording(tmp_path / "dataset")] == [f.name for f in frames]
    frame, labels = frames[0].load(), frames[0].point_truth()
    semantic, instance = labels.classes, labels.instances
    assert len(frame) == len(semantic) == len(instance) == 4400
    assert semantic.dtype == instance.dtype == np.uint16
    assert semantic[[0, 4000, 4200]].tolist() == [40, 10, 252]
    assert instance[[0, 4000, 4200]].tolist() == [0, 7, 300]


@pytest.mark.parametrize(
    "root, file, content, text",
    [
        ("nowhere", None, None, "does not exist"),
        (".", None, None, "is not a recording"),
        ("unlabelled", "velodyne/000000.bin", b"", "scans but no labels"),
        ("kitti", "velodyne/000001.bin", b"", "cannot read .*label"),
        ("kitti", "labels/000000.label", bytes(40), "has 10 labels for the 4402 points"),
        ("kitti", "labels/000000.label", bytes(41), "not a multiple of 4"),
        ("kitti", "velodyne/000000.bin", bytes(41), "not a multiple of 16"),
    ],
)
def test_error_for_broken_folder_names_the_remedy(tmp_path, root, file, content, text):
    write_semantic_folder(tmp_path / "kitti", ["00/000000"])
    if file:
        write_file(tmp_path / root / "sequences/00" / file, content)
    with pytest.raises(InputError, match=text) as error:
        for frame in open_recording(tmp_path / root):
            frame.load()
            frame.point_truth()
    assert "\n" not in str(error.value) and re.search("give|expected|again", str(error.value))


@needs_data
def test_real_scan_has_a_label_for_every_point():
    first = open_recording(DATA / "semantickitti").frames[0]
    frame, labels = first.load(), first.point_truth()
    semantic, instance = labels.classes, labels.instances
    assert len(frame) == len(semantic) == len(instance) > 100_000
    assert np.isin(semantic, GROUND).mean() > 0.4
    cars = np.bincount(instance[semantic == 10])
    assert find_instances(frame.xyz, semantic, instance).classes.count("car") == np.sum(cars[1:] >= 10)


def run(*arguments):
    return CliRunner().invoke(segmentation, [str(a) for a in arguments])


def test_command_scores_every_method_and_skips_broken_scan(tmp_path):
    root = write_semantic_folder(tmp_path / "semantic")
    write_file(root / "sequences/00/labels/000001.label", b"")
    kitti = write_object_folder(tmp_path / "kitti", make_walker_label() + "\n")
    path = tmp_path / "made/here/scores.json"
    result = run("--data", root, "--data", kitti, "--json", path)
    assert result.exit_code == 0, result.output
    content = json.loads(path.read_text())
    assert len(content["skipped"]) == 1 and "skipped" in result.stdout
    assert list(content["ground"]) == list(GROUND_METHODS)
    assert {report["scans"] for report in content["ground"].values()} == {2}
    assert set(content["clusters"]) == {"SemanticKITTI", "KITTI object data"}
    for reports in content["clusters"].values():
        assert list(reports) == list(CLUSTERING_METHODS)
    cars, walkers = (content["clusters"][s]["dbscan"] for s in ("SemanticKITTI", "KITTI object data"))
    assert (cars["objects"], cars["hits"], cars["precision"]) == (4, 4, 1)
    assert (walkers["objects"], walkers["frames"]) == (2, 2)


def test_methods_and_frames_can_be_chosen(tmp_path):
    root, path = write_semantic_folder(tmp_path), tmp_path / "a.json"
    assert run("--data", root, "--methods", "threshold", "--limit", 1, "--json", path).exit_code == 0
    content = json.loads(path.read_text())
    assert list(content["ground"]) == ["threshold"] and content["clusters"] == {}
    ground = content["ground"]["threshold"]
    assert ground["scans"] == 1 and ground["protocols"]["without vegetation"]["f1"] > 0.99


def test_error_for_invalid_call_names_the_reason(tmp_path):
    root = write_semantic_folder(tmp_path / "semantic", ["00/000000"])
    kitti = write_object_folder(tmp_path / "kitti")
    for arguments, text in (
        ([], "DATA is missing"),
        (["--data", root, "--methods", "magic"], "unknown method"),
        (["--data", kitti, "--methods", "threshold"], "require labelled points"),
    ):
        result = run(*arguments)
        assert result.exit_code == 2 and text in result.output
    write_file(root / "sequences/00/labels/000000.label", b"")
    with pytest.raises(InputError, match="no frame with labels"):
        raise run("--data", root).exception


@pytest.mark.parametrize("command", [segmentation, candidates])
def test_bag_of_a_lower_sensor_scores_equally(command, tmp_path):
    """The sensor height is measured unless an option gives it."""

    def scores(name, lower, *flags):
        path, bag = tmp_path / f"{name}.json", tmp_path / name
        write_bag(bag, [make_lowered_crowd(i, lower) for i in range(3)])
        call = "--data", str(bag), "--json", str(path), *flags
        result = CliRunner().invoke(command, call, catch_exceptions=False)
        assert result.exit_code == 0, result.output
        content = json.loads(path.read_text())
        return (
            [content[stage]["all"]["tp"] for stage in STAGES]
            if command is candidates
            else [(row["hits"], row["clusters"]) for rows in content["clusters"].values() for row in rows.values()]
        )

    usual = scores("usual", 0.0)
    assert np.min(usual) > 0 and scores("lower", 1.0) == usual
    assert scores("told", 1.0, "--set", "ground.sensor_pose.height=1.6") != usual
