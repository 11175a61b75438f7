"""The benchmark: contenders, agreement of results, and tables. Times are not tested."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from samples import make_scene, make_walker_label, write_object_folder

from benchmark import ground, peers, plain_euclidean, startup
from benchmark.clustering import have_same_clusters, measure_dbscan, measure_dbscans
from benchmark.detection import measure_detection, measure_engines, print_detection
from benchmark.plain_pointnet2 import query_ball, sample_farthest
from benchmark.pointnet import measure_pointnet, print_pointnet
from benchmark.rows import format_target, format_value, make_row, print_ground, print_measured
from benchmark.startup import measure_startup
from benchmark.timing import Clock, run_in_child, time_interleaved
from lidar_perception.clustering.euclidean import cluster_euclidean
from lidar_perception.clustering.params import EuclideanParams
from lidar_perception.data.frame import Frame, PointTruth
from lidar_perception.data.open import open_recording
from lidar_perception.detectors.pointpillars import detector as pointpillars
from lidar_perception.types import PointCloud

pytestmark = pytest.mark.no_cover  # benchmark/ is not in the package
SKLEARN = [p.name for p in peers.SKLEARN]
OPTIONAL = ("dbscan", "open3d", "CSF", "pypatchworkpp")


def cloud(seed=0):
    """Points (N, 3) float32: clusters in every band, and noise."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-25, 25, (30, 3)) * [1, 1, 0.05]
    clusters = np.repeat(centres, 40, axis=0) + rng.normal(0, 0.08, (1200, 3))
    return np.concatenate([clusters, rng.uniform(-30, 30, (300, 3))]).astype(np.float32)


@pytest.fixture
def nothing_installed(monkeypatch):
    for name in OPTIONAL:
        monkeypatch.setitem(sys.modules, name, None)  # the import fails as if the package were missing


def test_contenders_run_in_turn_after_untimed_warm_up():
    called = []
    ms, results = time_interleaved({name: lambda name=name: called.append(name) or name.upper() for name in "abc"}, 3)
    assert called == list("abc" * 3)
    assert results == {"a": "A", "b": "B", "c": "C"} and ms.keys() == results.keys()
    called.clear()
    clock = Clock(2, {"a": lambda: called.append("warm")})
    for _ in range(3):
        clock.time({"a": lambda: called.append("a")})
    assert called == ["warm"] + 6 * ["a"] and len(clock.ms["a"]) == 3


@pytest.mark.parametrize("place", range(len(peers.DBSCANS)))
def test_dbscan_of_other_packages_gives_the_same_clusters(place):
    peer = peers.DBSCANS[place]
    if peer.find_problem():
        pytest.skip(f"{peer.package} is {peer.find_problem()}")
    arguments = ([place], [cloud()], 1, "test")
    _, same, differ = run_in_child(measure_dbscans, *arguments) if peer == peers.WHEEL else measure_dbscans(*arguments)
    assert same[peer.name] == 1 and differ[peer.name] == 0


@pytest.mark.parametrize("threshold", ["local", "global"])
def test_plain_euclidean_gives_the_same_clusters(threshold):
    params = EuclideanParams(threshold=threshold)
    ours = cluster_euclidean(cloud(), params)
    assert ours.max() > 0
    np.testing.assert_array_equal(plain_euclidean.cluster_euclidean(cloud(), params), ours)


def test_same_clusters_compares_noise_and_core_partition():
    core = np.array([True, True, True, False, False])
    ours = np.array([1, 1, 2, 2, 0])
    assert have_same_clusters(np.array([7, 7, 3, 7, 0]), ours, core)  # other ids, another border point
    assert not have_same_clusters(np.array([7, 7, 3, 3, 4]), ours, core)  # a point is noise
    assert not have_same_clusters(np.array([7, 7, 7, 7, 0]), ours, core)  # merged clusters
    assert not have_same_clusters(np.array([7, 8, 3, 3, 0]), ours, core)  # a split cluster


@pytest.mark.parametrize(
    "unit, target, good, bad, text",
    [("x", 12, 12.0, 11.9, "12x"), ("ms", 60, 59.9, 60.0, "< 60 ms"), ("", 1.1, 1.0, 1.1, "< 1.1")],
)
def test_missed_target_is_marked(unit, target, good, bad, text):
    assert make_row("a", value=good, unit=unit, target=target)["met"] is True
    assert make_row("a", value=bad, unit=unit, target=target)["met"] is False
    assert make_row("a", value=None, unit=unit, target=target)["met"] is None
    assert format_target(target, unit) == text and format_value(None, unit) == ""


def test_missing_peers_are_reported(nothing_installed, capsys):
    xyz, frame = cloud(), PointCloud(make_scene()[:, :3], make_scene()[:, 3])
    for content in (
        measure_dbscan("DBSCAN", [xyz], 1, 12.0),
        ground.measure_patchwork([frame], 1),
        ground.measure_cloth([xyz], 1),
    ):
        print_measured(json.loads(json.dumps(content)))
        assert "not installed" in capsys.readouterr().out
        for r in content["rows"]:
            assert (r["name"] in SKLEARN) == (r["note"] == "") == (r["value"] is not None)


def test_ground_is_scored_without_the_peer_libraries(nothing_installed, capsys):
    points = make_scene()
    semantic = np.where(points[:, 2] < -1.6, 40, 30).astype(np.uint16)
    scan = Frame.of(
        "a", PointCloud(points[:, :3], points[:, 3]), point_truth=lambda: PointTruth(semantic, np.zeros_like(semantic))
    )
    content = ground.measure_labelled([scan], 1)
    print_ground(json.loads(json.dumps(content)))
    assert capsys.readouterr().out.count("not installed") == 2 * len(content["protocols"])
    assert content["methods"]["cloth"]["protocols"]["with vegetation"]["f1"] > 0.9


def test_every_version_is_timed_step_by_step_on_random_weights(one_thread, capsys, monkeypatch):
    points, ran, experts = make_scene(), {}, pointpillars.run_experts

    def seen(frame, config, *arguments):
        columns = experts(frame, config, *arguments)
        ran[config.version] = tuple(column is not None for column in columns)
        return columns

    monkeypatch.setattr(pointpillars, "run_experts", seen)
    content = measure_detection([PointCloud(points[:, :3], points[:, 3])], 1, ("compact",))
    print_detection(json.loads(json.dumps(content)))
    output = capsys.readouterr().out
    versions = content["sizes"]["compact"]["versions"]
    assert list(versions) == ["v0", "v1", "v2", "v3", "v4"] and versions["v0"]["to_v0"] == 1.0
    for name, found in versions.items():
        assert sum(found["share"].values()) == pytest.approx(1.0)
        assert found["ms"]["network"] > 0 and found["ms"]["postprocess"] > 0
        assert name in output and found["to_v0"] == found["total_ms"] / versions["v0"]["total_ms"]
        assert found["ms"]["experts"] >= 0
    # Steps that a version does not need are not timed.
    assert ran == {"v0": (False, False), "v1": (True, False), **dict.fromkeys(("v2", "v3", "v4"), (True, True))}


def test_engines_are_timed_and_compared(one_thread, capsys):
    points = make_scene()
    content = measure_engines([PointCloud(points[:, :3], points[:, 3])], 1, ("pointpillars",))
    print_measured(json.loads(json.dumps(content)))
    assert "around, engine torch" in " ".join(capsys.readouterr().out.split())
    assert [(make_row["same"], make_row["value"] > 0) for make_row in content["rows"]] == [(1, True)] * 2


@pytest.mark.no_cover
def test_startup_is_measured_with_and_without_torch(monkeypatch, capsys):
    monkeypatch.setattr(
        startup, "CODE_BY_NAME", {"fused": "a = 0", "fused, engine torch": "import numpy", "clustering": "a = 1"}
    )
    content = measure_startup(1, cold_starts=("clustering",))
    print_measured(json.loads(json.dumps(content)))
    assert "empty cache" in " ".join(capsys.readouterr().out.split())
    assert content["rows"][0]["value"] > 1  # loading NumPy takes longer than loading nothing


def test_pointnet_is_timed_against_a_plain_network(one_thread, capsys):
    points = make_scene()
    content = measure_pointnet([PointCloud(points[:, :3], points[:, 3])] * 2, 1)
    print_pointnet(json.loads(json.dumps(content)))
    output = capsys.readouterr().out
    assert all(name in output for name in ("improved PointNet", "plain PointNet++", "clustering"))
    assert content["clusters"] >= 1 and all(value > 0 for value in content["ms"].values())
    # The plain PointNet++ uses farthest point sampling and ball queries.
    xyz = torch.tensor([[[0.0, 0, 0], [5, 0, 0], [0.1, 0, 0], [0, 0.3, 0]]])
    assert sample_farthest(xyz, 3).tolist()[0][:2] == [0, 1]
    assert query_ball(0.2, 2, xyz, xyz[:, :1]).tolist() == [[[0, 2]]]


def test_command_writes_the_measurements(nothing_installed, monkeypatch, tmp_path):
    pytest.importorskip("cv2")
    monkeypatch.setattr(peers, "MAX_TRIALS", 20)
    import benchmark.__main__ as benchmark

    monkeypatch.setattr(
        benchmark,
        "measure_startup",
        lambda repeat: {  # compiling takes minutes
            "title": "start",
            "frames": 0,
            "points": 0,
            "rows": [],
        },
    )
    root, out = write_object_folder(tmp_path / "kitti", make_walker_label(), 1), tmp_path / "b.json"
    done = CliRunner().invoke(
        benchmark.main,
        ["--data", str(root), "--json", str(out), "--repeat", "1", "--frames", "1", "--no-graph"],
        catch_exceptions=False,
    )
    assert done.exit_code == 0, done.output
    content = json.loads(out.read_text())
    assert {"machine", "peers", "candidates", "dbscan_in_view", "threshold_in_view", "startup"} == set(content)
    assert content["peers"]["open3d"] == "not installed"
    assert content["dbscan_in_view"]["rows"][0]["same"] == 1


def test_graph_table_has_speed_and_cpu_time(drive_bag, monkeypatch, capsys):
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    from benchmark.graph import RUNS, measure_graph, print_graph
    from lidar_perception.nodes.replay import graph_replay

    calls = []

    def replay(drive, clouds, out, **arguments):
        calls.append(arguments)
        return {
            "clouds": clouds,
            "results": clouds - 1,
            "memory_mb": 900.0,
            "latency_ms": {"median": 140.0, "p95": 180.0},
            "stage_ms": {},
            "slower": 4.0,
            "cpu_ms_by_process": {"graph": 150.0, "bag_player": 10.0},
        }

    monkeypatch.setattr(graph_replay, "replay", replay)
    runs = measure_graph(open_recording(drive_bag))
    assert [*runs] == [*RUNS] and calls == [arguments for arguments, _ in RUNS.values()]
    assert {(run["speed"], run["cpu_ms"]) for run in runs.values()} == {(0.25, 160.0)}
    print_graph(runs)
    assert "0.25x" in capsys.readouterr().out
