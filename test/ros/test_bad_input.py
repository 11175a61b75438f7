"""Invalid clouds become diagnostics, and the node processes the next valid one."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from ros_samples import BAD, CLOUD, MARKERS, QUIET, make_ros_cloud, to_big_endian

from lidar_perception.data.open import open_recording
from lidar_perception.scoring.centres.report import select_pedestrians
from lidar_perception.testing.detections import assert_detections
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import to_point_cloud
from msg_utils.markers import from_marker_array
from msg_utils.point_cloud2 import to_array
from msg_utils.stamps import make_header, to_ns


def read_xyz(msg):
    return to_point_cloud(msg)[0].xyz


@pytest.fixture(scope="module")
def peer(shared_peer):
    return shared_peer


@pytest.fixture(scope="module")
def send(shared_processes, peer):
    """Return send(node, cloud, condition, what), which sends until the condition holds."""
    nodes = "ground_segmentation", "perception", "clustering", "candidate_refinement"
    talkers = {node: peer.advertise(f"/{node}/input/points", CLOUD) for node in nodes}
    for node in nodes:
        shared_processes.start(node, {}, {**QUIET, "seed.source": "file"})
    return lambda node, *rest: peer.send(talkers[node], *rest)


@pytest.fixture(scope="module")
def results(peer):
    """Return {node: published clouds}."""
    return {node: peer.listen(f"/{node}/output/points", CLOUD) for node in ("ground_segmentation", "perception")}


@pytest.fixture(scope="module")
def process(send, results):
    """Return a function that sends a cloud to a node and returns the cloud that it publishes."""

    def process_cloud(node, msg):
        stamp, received = to_ns(msg.header.stamp), results[node]
        send(node, msg, lambda: received and to_ns(received[-1].header.stamp) == stamp, "the cloud's result")
        return received[-1]

    return process_cloud


@pytest.mark.parametrize("node", ["ground_segmentation", "perception"])
def test_bad_clouds_are_reported_and_node_continues(node, send, process, peer, good_cloud):
    for name, (msg, words) in BAD.items():
        peer.diagnostics.clear()
        send(node, msg, lambda w=words: w in peer.get_message(node), f"'{words}': {name}")
    result = process(node, good_cloud)
    assert result.width == good_cloud.width
    names = [f.name for f in result.fields]
    assert names[:4] == ["x", "y", "z", "intensity"] and "ground" in names


@pytest.mark.parametrize(
    "values",
    [
        {"ground.method": "patchwork"},
        {"ground.method": "cloth"},
        {"ground.method": "cloth", "clustering.method": "euclidean", "boxes.shape": "l_shape"},
    ],
    ids=["patchwork", "cloth", "paper C"],
)
def test_every_method_survives_invalid_clouds(values, send, process, results, shared_processes, peer, good_cloud):
    """Some libraries crash on NaN, outliers or empty clouds."""
    node = "perception" if "clustering.method" in values else "ground_segmentation"
    rng = np.random.default_rng(0)
    xyz = read_xyz(good_cloud)
    some = xyz[:: len(xyz) // 2000][:2000]
    strange = {
        **{name: msg for name, (msg, _) in BAD.items()},
        "100 km": make_ros_cloud(np.concatenate([some, [[1e5, -1e5, 1e5]]])),
        "1e38": make_ros_cloud(np.concatenate([some, [[1e38, 0, 0]]])),
        "upside down": make_ros_cloud(xyz * [1, -1, -1]),
        "all equal": make_ros_cloud(np.full((3000, 3), 7.0)),
        "no ground": make_ros_cloud(rng.uniform(3, 9, (3000, 3))),
        "all ground": make_ros_cloud(rng.uniform(-30, 30, (3000, 3)) * [1, 1, 0] - [0, 0, 1.73]),
        "a million": make_ros_cloud(rng.uniform(-50, 50, (1_000_000, 3)) * [1, 1, 0.05]),
    }
    before = len(results[node])
    with peer.override_parameters(f"/{node}", values):
        for stamp, msg in enumerate(strange.values(), start=10):
            send(node, msg, lambda: True, "a subscriber")
            process(node, make_ros_cloud(some, stamp))
    assert {r.width for r in results[node][before:]} >= {1_000_000, len(xyz), 2001}
    assert "PatchWork" not in shared_processes.read_log(node)


def test_wrong_height_and_intensity_scale_are_reported(send, peer, good_cloud):
    """The sensor is mounted at 1.73 m; intensity is 0..1."""

    def is_reported(words):
        send(node, good_cloud, lambda: words in peer.get_message(node), words)

    node = "ground_segmentation"
    with peer.override_parameters(f"/{node}", {"ground.method": "patchwork", "ground.sensor_pose.height": 1.2}):
        is_reported("ground.sensor_pose.height is 1.2; set it to 1.7")
        with peer.override_parameters(f"/{node}", {"ground.sensor_pose.height": 1.73, "input.intensity_max": 0.001}):
            is_reported("input.intensity_max")
    is_reported("segmenting")
    assert peer.get_message(node) == "segmenting"
    assert abs(float(peer.get_value(node, "sensor_height")) - 1.73) < 0.1
    assert 0.5 < float(peer.get_value(node, "plane_inlier_share")) <= 1.0


def test_layout_does_not_change_the_result(process, good_cloud):
    """Big-endian, organised and NaN-padded clouds have the same ground as the plain cloud."""
    xyz = read_xyz(good_cloud)[:40_000]
    holes = np.full((20_000, 3), np.nan, np.float32)
    organised = make_ros_cloud(np.concatenate([xyz, holes, np.zeros_like(holes)]), 103, is_dense=False)
    organised.height, organised.width = 8, 10_000
    organised.row_step = organised.width * organised.point_step
    clouds = [
        process("ground_segmentation", msg) for msg in (make_ros_cloud(xyz, 101), to_big_endian(xyz, 102), organised)
    ]
    plain, big, grid = (to_array(msg)["ground"] for msg in clouds)
    assert plain.sum() > 1000
    np.testing.assert_array_equal(plain, big)
    np.testing.assert_array_equal(plain, grid[: len(plain)])
    assert not grid[len(plain) :].any() and clouds[-1].height == 8


def test_clustering_and_refinement_name_the_missing_column(send, peer, good_cloud):
    for node, name in ("clustering", "ground"), ("candidate_refinement", "cluster_id"):
        send(
            node,
            good_cloud,
            lambda n=node, w=name: f"no column '{w}'" in peer.get_message(n),
            f"a diagnostic of {node}",
        )


def test_diagnostics_report_missing_camera_and_seed(send, peer, good_cloud, drive_bag):
    """The cases are: view.enabled without CameraInfo, no seed, and a clicked pedestrian."""

    def is_reported(words):
        send("perception", good_cloud, lambda: words in peer.get_message("perception"), words)

    with peer.override_parameters("/perception", {"seed.source": "click"}):
        with peer.override_parameters("/perception", {"view.enabled": True, "input.max_wait": 0.5}):
            is_reported("camera calibration")
        found = peer.listen("/perception/output/detections", MARKERS)
        is_reported("no seed yet")
        peer.wait(lambda: found, "candidates")
        assert len(from_marker_array(found[-1])) == 0

        people = select_pedestrians(next(iter(open_recording(drive_bag))).truth())
        nearest = people[np.argmin(np.hypot(people[:, 0], people[:, 1]))]
        click = peer.advertise("/clicked_point", "geometry_msgs/msg/PointStamped")
        point = make_bag_message("geometry_msgs/msg/Point", x=nearest[0], y=nearest[1], z=nearest[2])
        for frame_id, words in (("map", "frame 'map'"), ("velodyne", "detecting")):
            clicked = make_bag_message(
                "geometry_msgs/msg/PointStamped", point=point, header=make_header(0, frame_id, make_bag_message)
            )
            peer.send(click, clicked, click.get_subscription_count, "a subscriber of the click")
            is_reported(words)
        peer.wait(lambda: len(from_marker_array(found[-1])), "candidates, which may come late")
    objects = from_marker_array(found[-1])
    assert_detections(objects, [("Pedestrian", nearest)], max_extra=None)
    assert set(objects.labels) == {"Pedestrian"} and objects.frame_id == "velodyne"
