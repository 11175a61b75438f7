"""Invalid arguments and recordings: one line on stderr and exit code 2."""

from __future__ import annotations

import subprocess
import sys

import pytest
from cli_samples import read_error_line, run_main
from samples import write_file, write_object_folder

from lidar_perception.data.bag import BagWriter
from lidar_perception.types import find_closest_name
from lidar_perception.wire.topics import POINTS


@pytest.mark.parametrize(
    "words",
    [
        "train pointpillars sim --sensor vlp99",
        "train pointnet sim --scene stret",
        "train pointnet none",
        "train pointnet sim --init none",
        "train pointnet sim --set lrr=1",
        "train pointnet --ablation sim --sensor vlp99",
        "simulate --format kitti --sensor vlp99",
        "simulate --format kitti --scene stret",
        "simulate --format kitti --kind nowhere",
        "simulate --format kiti",
        "demo none",
        "demo --detector fuesd",
        "setup none",
        "setup {kitti} --topic /a",
        "label none",
        "label {kitti} --sequence 7",
        "label {kitti} --import openlabl:x",
        "convert none",
        "convert {kitti} --to kiti",
        "evaluate detection {kitti} --weights fussed",
        "detect {kitti} --weights fussed",
        "detect {kitti} --format kiti",
        "detect none",
        "seed none",
        "seed {kitti} --frame 9",
    ],
)
def test_invalid_command_creates_no_files(words, kitti, tmp_path, monkeypatch, capsys):
    option = "--write-results" if words.startswith("evaluate") else "--out"
    assert run_main(monkeypatch, *words.format(kitti=kitti).split(), option, tmp_path / "not/there") == 2
    assert "Error: " in capsys.readouterr().err
    assert not (tmp_path / "not").exists()


BAD_INPUTS = {
    "missing bag": (["info", "{tmp}/none"], "the bag {tmp}/none does not exist"),
    "too long a name": (["info", f"{{tmp}}/{300 * 'a'}"], "a: File name too long"),
    "no bag": (
        ["info", "{tmp}"],
        "{tmp} has no metadata.yaml and is not another kind of recording: expected a rosbag2 bag, or the folder of ",
    ),
    "missing data": (["convert", "{tmp}/none", "--out", "{tmp}/o"], "{tmp}/none does not exist"),
    "no data": (["convert", "{tmp}", "--out", "{tmp}/o"], "{tmp} is not a recording in a supported format"),
    "existing out": (["convert", "{kitti}", "--out", "{bag}"], "already exists"),
    "out is a file": (["convert", "{kitti}", "--out", "{kitti}/training/calib/000000.txt", "--force"], "is not a bag"),
    "out under a file": (
        ["convert", "{kitti}", "--out", "{kitti}/training/calib/000000.txt/o"],
        "cannot create the folder",
    ),
    "out of range": (
        ["evaluate", "candidates", "--data", "{bag}", "--set", "ground.cloth.resolution=99"],
        "ground.cloth.resolution = 99.0 is outside 0.1 .. 10.0",
    ),
    "lengths": (
        ["evaluate", "candidates", "--data", "{bag}", "--set", "clustering.dbscan.eps=0.1"],
        "one more eps than range_limits",
    ),
    "missing config": (["evaluate", "candidates", "--data", "{bag}", "--config", "{tmp}/none"], "{tmp}/none"),
    "missing template": (
        ["evaluate", "candidates", "--data", "{bag}", "--set", "seed.source=file", "--set", "seed.file={tmp}/none"],
        "{tmp}/none",
    ),
    "json under a file": (
        ["evaluate", "candidates", "--data", "{bag}", "--json", "{kitti}/training/calib/000000.txt/o"],
        "cannot write",
    ),
    "json is a folder": (["evaluate", "candidates", "--data", "{tmp}/none", "--json", "{tmp}"], "cannot write {tmp}"),
    "detector": (
        ["evaluate", "detection", "--data", "{kitti}", "--weights", "fussed"],
        "'fussed'; did you mean 'fused'? Valid names: pointpillars, pointnet, fused",
    ),
    "no standard output": (
        ["evaluate", "candidates", "--data", "{tmp}/none", "--json", "-"],
        "cannot write -; give the name of a file",
    ),
}


@pytest.mark.parametrize("case", BAD_INPUTS)
def test_bad_input_prints_one_line_to_stderr_and_exits_with_2(case, kitti, bag, tmp_path, monkeypatch, capsys):
    def fill_paths(text):
        return text.format(tmp=tmp_path, kitti=kitti, bag=bag)

    arguments, words = BAD_INPUTS[case]
    assert run_main(monkeypatch, *map(fill_paths, arguments)) == 2
    assert fill_paths(words) in read_error_line(capsys)


def test_bag_without_clouds_is_bad_input(tmp_path, monkeypatch, capsys):
    with BagWriter(tmp_path / "bag") as writer:
        writer.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
    for command in "nuscenes", "detection":
        assert (
            run_main(
                monkeypatch,
                "evaluate",
                command,
                "--data",
                tmp_path / "bag",
                "--weights",
                "fused",
                "--write-results",
                tmp_path / "out",
            )
            == 2
        )
        assert "has no frames" in read_error_line(capsys)


def test_missing_pedestrian_is_reported_and_scores_file_is_kept(tmp_path, monkeypatch, capsys):
    root = write_object_folder(tmp_path / "kitti", "")
    write_file(tmp_path / "s.json", "those from before")
    assert run_main(monkeypatch, "evaluate", "candidates", "--data", root, "--json", tmp_path / "s.json") == 2
    assert "no frame with a Pedestrian label" in capsys.readouterr().err
    assert (tmp_path / "s.json").read_text() == "those from before"


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["bogus"], "unknown command 'bogus'; valid names: demo"),
        (["evaluate", "candidates"], "DATA is missing"),
        (["evaluate", "candidates", "--data", "a", "--jobs", "2", "--dask", "b"], "cannot be combined"),
        (
            ["evaluate", "candidates", "--data", "b", "--set", "clustering.dbscan.min_samples=few"],
            "must be a whole number",
        ),
        (["evaluate", "candidates", "--data", "b", "--set", "clustering.dbscan.eps=0.1,wide"], "list of numbers"),
        (["evaluate", "candidates", "--data", "b", "--set", "seed.source=luck"], "'luck'"),
        (["evaluate", "candidates", "--data", "b", "--set", "stm.threshold"], "must be NAME=VALUE"),
        (["evaluate", "detection", "--data", "b", "--set", "fused.score.car=1"], "did you mean 'fused.scores.car'?"),
        (["detect", "b", "--out", "o", "--set", "input.intensity_max=255"], "read by nodes"),
        (["demo", "b", "--frames", "4"], "--frames applies to the simulated drive"),
        (["evaluate", "detection", "b", "--results", "r", "--min-score", "0.1"], "--min-score requires --weights"),
        (["evaluate", "detection", "--data", "b", "--set", "scores=1"], "unknown parameter 'scores'"),
        (
            ["evaluate", "detection", "--data", "b", "--results", "r", "--set", "fused.amp=auto"],
            "give either --results",
        ),
        (["evaluate", "detection", "--data", "b", "--wieghts", "fused"], "did you mean '--weights'?"),
        (["evaluate", "candidates", "--data", "b", "--config", "bset"], "did you mean 'best'?"),
        (["evaluate", "candidates", "--data", "b", "--stm-threshold", "0.5"], "no such option --stm-threshold"),
        (["evaluate", "trakcing"], "did you mean 'tracking'? Valid names: candidates, clusters"),
        (["evalute"], "did you mean 'evaluate'? Valid names: demo, convert"),
        (["run", "fused"], "did you mean 'fused_detector'?"),
        (["convert", "a", "--out", "b", "--limit", "0"], "0 is not in the range"),
        (["convert", "a"], "--out"),
        (["simulate", "--frames", "1", "--out", "."], "is not the name of a new file"),
        (["run", "bogus"], "'bogus'"),
    ],
)
def test_invalid_command_exits_with_2(arguments, words, monkeypatch, capsys):
    assert run_main(monkeypatch, *arguments) == 2
    assert words in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("name", "known", "closest"),
    [
        ("fussed", ["pointnet", "fused"], "fused"),
        ("fused", ["tracker", "fused_detector"], "fused_detector"),
        ("vlp99", ["hdl-64e", "vlp-16", "vlp-32c"], "vlp-16"),
        ("KITTI_traking", ["kitti-tracking"], "kitti-tracking"),
        ("luck", ["seeds", "points"], None),
        ("", ["a"], None),
        (None, ["x"], None),
    ],
)
def test_error_suggests_the_closest_name(name, known, closest):
    assert find_closest_name(name, known) == closest


@pytest.mark.parametrize(
    "arguments, code, words", [(["--version"], 0, ""), (["info", "none"], 2, "Error: the bag none does not exist\n")]
)
def test_process_returns_the_exit_code(arguments, code, words, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "lidar_perception.cli.main", *arguments], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (code, words)
