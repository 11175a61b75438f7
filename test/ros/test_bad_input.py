"""No message ends a node: each bad cloud becomes a diagnostic, and the next good one is served."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from lidar_perception.data.bag import Bag
from lidar_perception.wire.codec import bag_message, encode
from lidar_perception.wire.messages import to_frame
from lidar_perception.wire.topics import POINTS
from msg_utils.markers import from_marker_array
from msg_utils.point_cloud2 import from_array
from msg_utils.stamps import header_message, to_ns

CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
XYZ = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])


def cloud(xyz, stamp=1, **changes):
    points = np.asarray(xyz, np.float32).reshape(-1, 3).view(XYZ).reshape(-1)
    msg = from_array(points, header_message(stamp, "lidar", bag_message), bag_message)
    for name, value in changes.items():
        setattr(msg, name, value)
    return msg


def xyz_of(msg):
    return to_frame(msg)[0].xyz


def without_x():
    msg = cloud(np.ones((5, 3)))
    msg.fields[0].name = "a"
    return msg


def integer_z():
    msg = cloud(np.ones((5, 3)))
    msg.fields[2].datatype = 5
    return msg


def big_endian(xyz, stamp):
    points = np.asarray(xyz, np.float32).view(XYZ).reshape(-1).astype(XYZ.newbyteorder(">"))
    return from_array(points, header_message(stamp, "lidar", bag_message), bag_message)


BAD = {  # what is wrong -> message, words that the diagnostic must hold
    "empty": (cloud(np.zeros((0, 3))), "no finite point"),
    "missing x": (without_x(), "no field 'x'"),
    "no fields at all": (bag_message(CLOUD), "no field 'x'"),
    "all NaN": (cloud(np.full((9, 3), np.nan)), "no finite point"),
    "cut": (cloud(np.ones((5, 3)), data=np.zeros(7, np.uint8)), "7 bytes"),
    "all infinite": (cloud(np.full((9, 3), np.inf)), "no finite point"),
    "integer z": (integer_z(), "'z'"),
    "more points than bytes": (cloud(np.ones((5, 3)), width=2**31), "bytes"),
    "point_step 0": (cloud(np.ones((5, 3)), point_step=0), "point_step"),
    "one point": (cloud([[5, 0, -1]]), "no ground"),
}


# Each cloud is to arrive, even where shared memory is small.
RELIABLE_IN = {"qos_overrides./in.subscription.reliability": "reliable"}


@pytest.fixture(scope="module")
def good_cloud(drive_bag):
    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))


@pytest.mark.parametrize("node", ["ground_segmentation", "perception"])
def test_bad_clouds_become_diagnostics_and_the_node_lives_on(node, processes, peer, good_cloud):
    processes.start(node, {"~/input/points": "/in", "~/output/points": "/out"},
                    RELIABLE_IN | ({"seed.source": "file"} if node == "perception" else {}))
    talker = peer.talker("/in", CLOUD)
    received = peer.listen("/out", CLOUD)
    for name, (msg, words) in BAD.items():
        peer.diagnostics.clear()
        peer.send(talker, msg, lambda w=words: w in peer.message_of(node), f"'{words}': {name}")
        processes.check()
    peer.send(talker, good_cloud, lambda: received and received[-1].width == good_cloud.width,
              "the result of a good cloud")
    names = [f.name for f in received[-1].fields]
    assert names[:4] == ["x", "y", "z", "intensity"] and "ground" in names


@pytest.mark.parametrize("values", [
    {"ground.method": "patchwork"}, {"ground.method": "cloth"},
    {"ground.method": "cloth", "clustering.method": "euclidean", "boxes.shape": "l_shape"},
], ids=["patchwork", "cloth", "paper C"])
def test_no_method_dies_of_a_strange_cloud(values, processes, peer, good_cloud):
    """The wheels behind some methods end the process on NaN, outliers or nothing at all."""
    node = "perception" if "clustering.method" in values else "ground_segmentation"
    processes.start(node, {"~/input/points": "/in", "~/output/points": "/out"}, {
        **RELIABLE_IN, "input.queue": 5, **values})
    talker, received = peer.talker("/in", CLOUD), peer.listen("/out", CLOUD)
    rng = np.random.default_rng(0)
    xyz = xyz_of(good_cloud)
    some = xyz[:2000]
    strange = {
        **{name: msg for name, (msg, _) in BAD.items()},
        "100 km": cloud(np.concatenate([some, [[1e5, -1e5, 1e5]]])),
        "1e38": cloud(np.concatenate([some, [[1e38, 0, 0]]])),
        "upside down": cloud(xyz * [1, -1, -1]),
        "all equal": cloud(np.full((3000, 3), 7.0)),
        "no ground": cloud(rng.uniform(3, 9, (3000, 3))),
        "all ground": cloud(rng.uniform(-30, 30, (3000, 3)) * [1, 1, 0] - [0, 0, 1.73]),
        "a million": cloud(rng.uniform(-50, 50, (1_000_000, 3)) * [1, 1, 0.05]),
    }

    def serve(stamp):
        """Send a good cloud and wait for its result: what came before it is done then."""
        msg = cloud(some, stamp)
        peer.send(talker, msg, lambda: received and to_ns(received[-1].header.stamp) == stamp,
                  "the result of a good cloud")

    serve(1)
    for stamp, msg in enumerate(strange.values(), start=2):
        talker.publish(encode(msg))
        serve(stamp)
        processes.check()
    assert {r.width for r in received} >= {1_000_000, len(xyz), 2001}
    assert "PatchWork" not in (processes.logs / f"{node}.log").read_text()


def test_a_wrong_height_and_a_wrong_scale_of_intensity_are_said(processes, peer, good_cloud):
    """The sensor hangs 1.73 m high; intensity is 0..1."""
    processes.start("ground_segmentation", {"~/input/points": "/in"},
                    RELIABLE_IN | {"ground.sensor_pose.height": 1.2, "ground.method": "patchwork"})
    talker = peer.talker("/in", CLOUD)
    peer.send(talker, good_cloud, lambda: "ground.sensor_pose.height is 1.2; set it to 1.7"
              in peer.message_of("ground_segmentation"), "the measured height")
    peer.set_parameter("/ground_segmentation", "ground.sensor_pose.height", 1.73)
    peer.set_parameter("/ground_segmentation", "input.intensity_max", 0.001)
    peer.send(talker, good_cloud, lambda: "input.intensity_max"
              in peer.message_of("ground_segmentation"), "the scale of the intensity")
    peer.set_parameter("/ground_segmentation", "input.intensity_max", 1.0)
    peer.send(talker, good_cloud, lambda: peer.message_of("ground_segmentation") == "segmenting",
              "a good state")
    values = {v.key: v.value for v in peer.diagnostics["ground_segmentation"].values}
    assert abs(float(values["sensor_height"]) - 1.73) < 0.1
    assert 0.5 < float(values["plane_inlier_share"]) <= 1.0


def test_layout_does_not_change_the_result(processes, peer, good_cloud):
    """Big-endian, organised and NaN-padded clouds give the ground of the plain cloud."""
    from msg_utils.point_cloud2 import to_array
    processes.start("ground_segmentation", {"~/input/points": "/in", "~/output/points": "/out"},
                    RELIABLE_IN)
    xyz = xyz_of(good_cloud)[:40_000]
    holes = np.full((20_000, 3), np.nan, np.float32)
    organised = cloud(np.concatenate([xyz, holes, np.zeros_like(holes)]), 3, is_dense=False)
    organised.height, organised.width = 8, 10_000
    organised.row_step = organised.width * organised.point_step
    talker, received = peer.talker("/in", CLOUD), peer.listen("/out", CLOUD)
    for i, msg in enumerate((cloud(xyz, 1), big_endian(xyz, 2), organised)):
        peer.send(talker, msg, lambda n=i: to_ns(received[-1].header.stamp) == n + 1
                  if received else False, "a result")
    results = {to_ns(m.header.stamp): to_array(m)["ground"] for m in received}
    plain, big, grid = results[1], results[2], results[3]
    assert plain.sum() > 1000
    np.testing.assert_array_equal(plain, big)
    np.testing.assert_array_equal(plain, grid[:len(plain)])
    assert not grid[len(plain):].any() and received[-1].height == 8


def test_clustering_and_refinement_name_the_missing_column(processes, peer, good_cloud):
    for node in ("clustering", "candidate_refinement"):
        processes.start(node, {"~/input/points": "/in"}, RELIABLE_IN)
    talker = peer.talker("/in", CLOUD)
    peer.send(talker, good_cloud, lambda: (
        "no column 'ground'" in peer.message_of("clustering")
        and "no column 'cluster_id'" in peer.message_of("candidate_refinement")), "diagnostics")
    processes.check()


def test_without_camera_and_seed_the_diagnostics_say_so_and_a_click_helps(
        processes, peer, good_cloud, drive_bag):
    """view.enabled without CameraInfo; then without a seed; then with a clicked pedestrian."""
    from lidar_perception.data.open import open_recording
    from lidar_perception.scoring.centres.report import pedestrians
    processes.start("perception", {"~/input/points": "/in", "~/output/detections": "/found"},
                    {"view.enabled": True, "seed.source": "click", "input.max_wait": 0.5})
    talker, found = peer.talker("/in", CLOUD), peer.listen("/found", MARKERS)
    peer.send(talker, good_cloud, lambda: "camera calibration" in peer.message_of("perception"),
              "no camera yet")
    peer.set_parameter("/perception", "view.enabled", False)
    peer.send(talker, good_cloud, lambda: found and "no seed yet" in peer.message_of("perception"),
              "no seed yet")
    assert len(from_marker_array(found[-1])) == 0

    people = pedestrians(next(iter(open_recording(drive_bag))).truth())
    nearest = people[np.argmin(np.hypot(people[:, 0], people[:, 1]))]
    click = peer.talker("/clicked_point", "geometry_msgs/msg/PointStamped")
    point = bag_message("geometry_msgs/msg/Point", x=nearest[0], y=nearest[1], z=nearest[2])
    for frame_id, words in (("map", "frame 'map'"), ("velodyne", "detecting")):
        clicked = bag_message("geometry_msgs/msg/PointStamped", point=point,
                              header=header_message(0, frame_id, bag_message))
        peer.send(click, clicked, click.get_subscription_count, "a subscriber of the click")
        peer.send(talker, good_cloud, lambda w=words: w in peer.message_of("perception"), words)
    peer.wait(lambda: len(from_marker_array(found[-1])), "candidates, which may come late")
    objects = from_marker_array(found[-1])
    assert np.linalg.norm(objects.boxes[:, :2] - nearest[:2], axis=1).min() < 1.0
    assert set(objects.labels) == {"Pedestrian"} and objects.frame_id == "velodyne"
