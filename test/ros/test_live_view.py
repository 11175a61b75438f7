"""view --live over DDS: a bag player, a detector with tracks, and the page."""

from __future__ import annotations

import json
import re
import sys
import urllib.request

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from browsing import browsing
from robot_messages import mount_pose, transforms

from lidar_perception.nodes.graph import SINGLE_PROCESS_CANDIDATES
from lidar_perception.nodes.transforms import NO_TF, STATIC_QOS, has_tf
from lidar_perception.robot.poses import transform_boxes
from lidar_perception.wire.codec import encode, make_bag_message
from lidar_perception.wire.messages import to_detections
from lidar_perception.wire.transforms import TF_MESSAGE
from msg_utils.markers import from_marker_array, to_marker_array
from msg_utils.stamps import make_header

MARKERS = "visualization_msgs/msg/MarkerArray"
FOUND = "/perception/output/detections"


class LiveView:
    """The running command, queried over HTTP."""

    def __init__(self, processes):
        self.processes = processes
        processes.run("view", [sys.executable, "-m", "lidar_perception.cli.main", "view", "--live", "--no-open"])

    @property
    def url(self):
        found = re.search(r"http://\S+", self.processes.read_log("view"))
        return found and found.group()

    def bytes(self, path):
        base, _, token = self.url.partition("?")
        with urllib.request.urlopen(f"{base}{path}?{token}") as reply:
            return reply.read()

    def json(self, path):
        return json.loads(self.bytes(path))


@pytest.fixture(scope="module")
def view(shared_processes, shared_peer):
    live_view = LiveView(shared_processes)
    shared_peer.wait(lambda: live_view.url, "the address of the page")
    return live_view


@pytest.fixture(scope="module")
def received(shared_processes, shared_peer, view, drive_bag):
    """Return the messages of the detector while a bag is played in a loop."""
    shared_peer.wait(
        lambda: any("no point clouds are published" in line for line in view.json("api/drive")["status"]["lines"]),
        "a clear line",
    )
    assert view.json("api/drive")["frames"] == []
    arrays = shared_peer.listen(FOUND, MARKERS)
    for node, remap in SINGLE_PROCESS_CANDIDATES.items():
        shared_processes.start(
            node, remap, {"seed.source": "ground_truth", "view.enabled": False, "tracking.enabled": True}
        )
    shared_processes.play(drive_bag, loop=True, rate=0.5)
    return arrays


def test_frames_have_the_published_columns_and_boxes(view, received, shared_peer):
    drive = None

    def complete():
        nonlocal drive
        drive = view.json("api/drive")
        kinds = {t["kind"] for t in drive["status"]["topics"] if t["received"]}
        return (
            kinds == {"detections", "tracks", "labels"}
            and len(drive["frames"]) >= 3
            and (drive["status"]["clouds"]["topic"] == "/perception/output/points")
        )

    shared_peer.wait(complete, "clouds with columns, detections, tracks and labels")

    def published(stamp_ns):
        """Return the messages of a stamp; the looped bag repeats it with other tracks."""
        return [to_detections(m) for m in map(from_marker_array, received[-40:]) if m.stamp_ns == stamp_ns]

    def compared():
        for frame in view.json("api/drive")["frames"][-20:]:  # older ones are dropped soon
            objects = view.json(f"api/labels/{frame['frame']}")
            rows = objects["detections"].get("perception")
            if rows and objects["labels"]:
                body = view.bytes(f"api/cloud/{frame['frame']}")
                count = int(np.frombuffer(body, np.uint32, 1, 4)[0])
                ground = np.frombuffer(body, np.uint8, count, 8 + 13 * count)
                if ground.any():  # not a cloud from before the first one with columns
                    found[:] = [
                        np.array([[*row[:7], row[8]] for row in rows]),
                        frame["stamp_ns"],
                        ground,
                        np.frombuffer(body, np.uint32, count, len(body) - 4 * count),
                    ]
        return found

    found: list = []
    shared_peer.wait(compared, "a frame with columns, detections and labels")
    boxes, stamp_ns, ground, clusters = found

    def as_published():  # the page may receive it before this listener
        expected = [np.column_stack([d.boxes, d.scores]) for d in published(stamp_ns)]
        return any(boxes.shape == e.shape and np.allclose(boxes, e, atol=1e-6) for e in expected)

    shared_peer.wait(as_published, f"detections as shown, {boxes}")
    assert 0.2 < ground.mean() < 1 and clusters.max() >= 1 and not clusters[ground == 1].any()
    shared_peer.wait(
        lambda: any(len(t["boxes"]) > 1 and t["trails"] for t in view.json("api/state")["tracks"]),
        "a track in several frames",
    )


def test_newest_frame_appears_and_replay_can_pause(view, received, shared_peer):
    with browsing() as browser:
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.set_default_timeout(120_000)
        page.goto(view.url)
        page.wait_for_selector("html[data-ready=true]", state="attached")
        first = page.evaluate("page.store.frame")
        page.wait_for_function("n => page.store.frame > n + 3 && page.store.results.frame > n + 3", arg=first)
        assert page.evaluate("page.store.cloud.count") > 1000
        page.keyboard.press(" ")  # pause
        page.wait_for_function("() => !page.store.playing && page.store.requestedFrame === page.store.frame")
        held = page.evaluate("page.store.frame")
        page.wait_for_function("() => page.store.status.clouds.skipped > 2")  # counted although paused
        page.keyboard.press(",")
        page.wait_for_function("n => page.store.frame === n - 1", arg=held)
        page.keyboard.press(" ")
        page.wait_for_function("n => page.store.playing && page.store.frame > n + 1", arg=held)
        assert page.locator("#errors .toast").count() == 0


def test_boxes_in_another_frame_are_transformed_by_tf(view, received, shared_peer):
    """The boxes of the detector, as a node with a target_frame publishes them."""
    talker, place = shared_peer.advertise("/robot/output/detections", MARKERS), mount_pose(0.5, 0.2, 1.7, 0.0, 0.0, 0.3)
    sent = 0

    def send():
        nonlocal sent
        if len(received) > sent:
            sent, found = len(received), from_marker_array(received[-1])
            talker.publish(
                encode(
                    to_marker_array(
                        transform_boxes(found.boxes, place),
                        found.labels,
                        found.scores,
                        make=make_bag_message,
                        header=make_header(found.stamp_ns, "base", make_bag_message),
                    )
                )
            )

    def lines():
        send()
        return view.json("api/drive")["status"]["lines"]

    shared_peer.wait(
        lambda: any("/robot/output/detections are not shown: TF does not connect 'base'" in line for line in lines()),
        "a line that names the frames",
    )
    if not has_tf():
        shared_peer.wait(lambda: NO_TF in lines(), "a line that says what is not installed")
        pytest.skip("the wheels of the pip environment lack tf2_msgs")
    static = shared_peer.advertise("/tf_static", TF_MESSAGE, STATIC_QOS)
    static.publish(encode(transforms(("base", "velodyne", place, 0))))

    def same():
        send()
        for frame in view.json("api/drive")["frames"][-20:]:
            found = view.json(f"api/labels/{frame['frame']}")["detections"]
            ours, theirs = (np.array([row[:7] for row in found.get(name, [])]) for name in ("robot", "perception"))
            if len(ours) and ours.shape == theirs.shape and np.allclose(ours, theirs, atol=1e-6):
                return True
        return False

    shared_peer.wait(same, "boxes of both, in one place")


def test_live_view_ends_cleanly_at_sigint(view, received, shared_processes):
    assert shared_processes.end("view", 60.0) == 0
    assert "Traceback" not in shared_processes.read_log("view")
