"""The command demo: replays a bag through the graph of the default detector and scores it."""

from __future__ import annotations

import json
import os
import shutil

import pytest
import torch

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from bag_samples import message_bytes
from cli_samples import run_main
from click.testing import CliRunner
from detector_node import assert_equal

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.cli.demo import RECORD, _print_pace, demo
from lidar_perception.data.bag import Bag
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.open import open_detector
from lidar_perception.nodes.graph import FINAL_STAGE, list_result_topics
from lidar_perception.nodes.replay import graph_replay
from lidar_perception.scoring.recorded import read_results
from lidar_perception.types import InputError
from lidar_perception.wire.codec import encode

FRAMES = 4  # enough to confirm tracks


def test_demo_scores_like_offline_in_one_or_many_processes(drive_bag, make_bag, tmp_path):
    """Tracks are bit-identical."""
    bag = make_bag(open_recording(drive_bag).frames[:FRAMES])
    frames = {frame.stamp_ns: frame for frame in open_recording(bag)}
    torch.set_num_threads(len(os.sched_getaffinity(0)))  # sums depend on the number of threads; nodes use all cores
    fused = open_detector(sensor_height=next(iter(frames.values())).sensor_height)
    expected = {stamp: fused(frame.load()).detections for stamp, frame in frames.items()}
    tracks = []
    for name, arguments in ("one", ["--one-process"]), ("many", ["--processes"]):
        out = tmp_path / name
        outcome = CliRunner().invoke(demo, ["--data", str(bag), *arguments, "--out", str(out)])
        assert outcome.exit_code == 0, outcome.output
        scores = json.loads((out / "scores.json").read_text())
        (found,) = read_results(out / "result", list_result_topics(False, "fused")[FINAL_STAGE])
        assert {f.stamp_ns for f in found} == frames.keys() and scores["results"] == len(frames)
        for answer in found:
            assert_equal(answer.objects, expected[answer.stamp_ns])
        people = scores["detections"]["Pedestrian"]
        assert people["hits"] > 0 and people["hits"] + people["missed"] == people["labels"]
        assert scores["tracks"]["scores"]["Pedestrian"]["hits"] > 0
        assert (out / "birdseye.png").stat().st_size > 10_000
        assert ("graph" in scores["memory_mb_by_process"]) == (name == "one")
        with Bag(out / "result") as result:
            tracks.append([encode(track) for _, _, track in result.messages({graph_replay.TRACKS})])  # DDS pads bytes
    assert tracks[0] == tracks[1] and len(tracks[0]) == FRAMES


@pytest.mark.parametrize(("real_time", "waiting"), [(False, graph_replay.AHEAD), (True, None)])
def test_real_time_demo_uses_the_input_queue_of_a_robot(drive_bag, tmp_path, monkeypatch, real_time, waiting):
    class Enough(Exception):
        pass

    def start(processes, node, remap, values):
        assert values.get("input.queue") == waiting  # None: the default of the node
        raise Enough

    monkeypatch.setattr(graph_replay.Processes, "start", start)
    with pytest.raises(Enough):
        graph_replay.replay(drive_bag, 1, tmp_path, PAPER, real_time=real_time)


@pytest.mark.parametrize(
    ("arguments", "node", "expected"),
    [
        (
            ["--set", "fused.scores.car=0.7", "--range", "around", "--device", "cpu"],
            "fused_detector",
            {"fused.scores.car": 0.7, "fused.range": "around", "fused.device": "cpu"},
        ),
        (["--set", "ground.method=cloth"], "ground_segmentation", {"ground.method": "cloth"}),
        (
            ["--detector", "candidates", "--config", "best", "--set", "stm.shifts=1"],
            "candidate_refinement",
            {"stm.shifts": 1, "stm.window": "metric"},
        ),
    ],
    ids=range(3),
)
def test_parameters_reach_the_nodes(drive_bag, tmp_path, monkeypatch, arguments, node, expected):
    values_by_node = {}

    def start(processes, name, remap, values):
        values_by_node[name] = values
        if name == "bag_recorder":
            raise InputError("enough")

    monkeypatch.setattr(graph_replay.Processes, "start", start)
    assert run_main(monkeypatch, "demo", drive_bag, *arguments, "--out", tmp_path / "out") == 2
    assert expected.items() <= values_by_node[node].items()


def test_demo_shows_no_latency_without_measurements(capsys):
    content = {"results": 1, "slower": 1.0, "memory_mb": 600.0, "stage_ms": {"tracker": 5.0}}
    _print_pace(content | {"latency_ms": {"median": 0.0, "p95": 0.0}, "cpu_ms_by_process": {"graph": -0.1}}, 1.0, 40)
    output = " ".join(capsys.readouterr().out.split())
    assert "1 results; latency not measured" in output and " 0 ms" not in output and "CPU" not in output


def test_demo_keeps_files_that_it_did_not_create(drive_bag, make_bag, tmp_path):
    out = tmp_path / "out"
    bag = make_bag(open_recording(drive_bag).frames[:1])
    mine = shutil.copytree(bag, out / "drive")
    for record, said in (None, "remove it, or give another --out"), ("{}", "would be replaced"):
        if record:
            (out / RECORD).write_text(record)
        outcome = CliRunner().invoke(demo, ["--data", str(mine), "--out", str(out)])
        assert said in str(outcome.exception)
    assert message_bytes(mine) == message_bytes(bag)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--config", "best"], "the configuration best is for candidates"),
        (["--set", "stm.threshold=0.5"], "unknown parameter 'stm.threshold' of fused"),
        (["--ground-method", "cloth"], "--set ground.method=VALUE"),
        (["--detector", "candidates", "--set", "fused.proposals=0.1"], "of candidates"),
    ],
)
def test_demo_rejects_parameters_of_another_detector(tmp_path, monkeypatch, capsys, arguments, words):
    assert run_main(monkeypatch, "demo", *arguments, "--out", tmp_path / "out") == 2
    assert words in capsys.readouterr().err and not (tmp_path / "out").exists()
