"""bag_player and bag_recorder: the messages of a bag arrive unchanged and in time."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from bag_samples import as_ros1
from cloud_samples import compressed_message, livox_message, livox_points
from mcap.reader import make_reader

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.task import Future
from std_srvs.srv import Trigger

from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.bag_metadata import LATCHED_QOS, SENSOR_QOS
from lidar_perception.nodes.diagnostics import WAITING
from lidar_perception.nodes.interfaces import LATCHED
from lidar_perception.wire.clouds import COMPRESSED, LIVOX
from lidar_perception.wire.codec import decode, make_bag_message
from lidar_perception.wire.topics import CAMERA_INFO, POINTS, TRUTH
from msg_utils.point_cloud2 import to_array
from msg_utils.stamps import to_ns

CLOUD, TEXT, INFO = ("sensor_msgs/msg/PointCloud2", "std_msgs/msg/String", "sensor_msgs/msg/CameraInfo")
START, STEP = 10**18, 10**8


@pytest.fixture(scope="module")
def text_bag(tmp_path_factory):
    """Write a bag: 20 messages 'n' on /text every 0.1 s, and 'latched' on /note at the start."""
    path = tmp_path_factory.mktemp("bag") / "texts"
    with BagWriter(path) as bag:
        bag.add_topic("/text", TEXT, SENSOR_QOS)
        bag.add_topic("/note", TEXT, LATCHED_QOS)
        bag.write("/note", START, make_bag_message(TEXT, data="latched"))
        for i in range(20):
            bag.write("/text", START + i * STEP, make_bag_message(TEXT, data=str(i)))
    return path


def get_texts(messages):
    return [m.data for m in messages]


def start(processes, bag, **params):
    processes.start("bag_player", {}, {"bag": str(bag), "wait_for": ["/text"], **params})


@pytest.mark.parametrize("ros", [2, 1])
def test_bytes_of_the_bag_are_published_unchanged(processes, peer, drive_bag, tmp_path, ros):
    played = drive_bag if ros == 2 else as_ros1(drive_bag, tmp_path / "drive.bag")
    with Bag(drive_bag) as bag:
        expected = {t: [d for topic, _, d in bag.raw_messages({t})] for t in (POINTS, TRUTH)}
    received = {
        POINTS: peer.listen_raw(POINTS, CLOUD),
        TRUTH: peer.listen_raw(TRUTH, "visualization_msgs/msg/MarkerArray"),
    }
    info = peer.listen(CAMERA_INFO, INFO, LATCHED)
    processes.start("bag_player", {}, {"bag": str(played), "wait_for": [POINTS, TRUTH]})
    peer.wait(lambda: processes.has_ended("bag_player"), "the end of the bag")
    peer.wait(lambda: all(len(received[t]) == len(expected[t]) for t in expected), "all messages")
    processes.check("bag_player")
    for topic, messages in expected.items():
        # The padding at the end of CDR may differ, the message may not.
        assert all(a[: len(b)] == b[: len(a)] and abs(len(a) - len(b)) < 4 for a, b in zip(received[topic], messages))
    assert len(info) == 1 and info[0].width == 1242


def test_offset_duration_topics_and_remapping_take_effect(processes, peer, text_bag):
    messages, note = peer.listen("/renamed", TEXT), peer.listen("/note", TEXT, LATCHED)
    start(
        processes, text_bag, start_offset=0.5, duration=1.0, remap=["/text:=renamed"], wait_for=["/renamed"], rate=10.0
    )
    peer.wait(lambda: processes.has_ended("bag_player") and len(messages) >= 10 and note, "ten messages")
    assert get_texts(messages) == [str(i) for i in range(5, 15)]
    assert get_texts(note) == ["latched"]  # although the offset skips it
    processes.check("bag_player")


def test_latched_topic_reaches_a_late_subscriber(processes, peer, text_bag):
    messages = peer.listen("/text", TEXT)
    start(processes, text_bag, start_paused=True)
    peer.wait(lambda: "playing" in peer.get_message("bag_player"), "the start")
    peer.call("/bag_player/resume", Trigger, Trigger.Request())
    peer.wait(lambda: messages, "a message")
    peer.call("/bag_player/pause", Trigger, Trigger.Request())
    note = peer.listen("/note", TEXT, LATCHED)
    peer.wait(lambda: note, "the latched message")


def test_static_transforms_accumulate_others_keep_last(monkeypatch, start_node, tmp_path):
    """Every publisher of static transforms sends its own, once."""
    from lidar_perception.nodes.replay import bag_player

    monkeypatch.setattr(bag_player, "TF_MESSAGE", TEXT)  # not in the ROS wheels
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/tf_static", TEXT, LATCHED_QOS)
        bag.add_topic("/info", INFO, LATCHED_QOS)
        for i in range(20):
            bag.write("/tf_static", START + i, make_bag_message(TEXT, data=str(i)))
            bag.write("/info", START + i, make_bag_message(INFO, width=i))
        bag.add_topic("/text", TEXT, SENSOR_QOS)
        bag.write("/text", START + STEP, make_bag_message(TEXT))
    player = start_node(bag_player.BagPlayer, bag=str(tmp_path / "bag"), start_offset=0.05)
    player._publish_latched()
    assert [decode(d, TEXT).data for d in player.sent["tf_static"]] == [*map(str, range(20))]
    assert [decode(d, INFO).width for d in player.sent["info"]] == [19]
    depths = {o.topic_name: o.publisher.qos_profile.depth for o in player.outputs.items}
    assert depths == {"/tf_static": 100, "/info": 10, "/text": 10}  # for late subscribers, too


def test_livox_and_compressed_clouds_are_played_as_point_clouds(start_node, tmp_path):
    """A cloud that cannot be converted is skipped; all other messages are played."""
    from lidar_perception.nodes.replay.bag_player import BagPlayer

    points = livox_points()
    plain = np.zeros(3, [(axis, "<f4") for axis in "xyz"])
    with BagWriter(tmp_path / "bag") as bag:
        for topic, kind, messages in (
            ("/livox", LIVOX[1], [livox_message(points)] * 2),
            ("/zlib", COMPRESSED, [compressed_message(plain, "zlib")]),
            ("/draco", COMPRESSED, [compressed_message(plain, "draco")] * 2),
            ("/text", TEXT, [make_bag_message(TEXT, data="text")]),
        ):
            bag.add_topic(topic, kind)
            for message in messages:
                bag.write(topic, START, message)
    player = start_node(BagPlayer, bag=str(tmp_path / "bag"))
    assert {p.topic_name: p.msg_type.__name__ for p in player.publishers_by_topic.values()} == {
        "/livox": "PointCloud2",
        "/zlib": "PointCloud2",
        "/draco": "PointCloud2",
        "/text": "String",
    }
    player.serve = lambda timeout_sec: None
    player._play_once()
    sent = {topic: [decode(d, TEXT if topic == "text" else CLOUD) for d in data] for topic, data in player.sent.items()}
    assert [np.array_equal(to_array(cloud)["x"], points["x"]) for cloud in sent["livox"]] == [True, True]
    assert [len(to_array(cloud)) for cloud in sent["zlib"]] == [3]
    assert (sent["draco"], get_texts(sent["text"]), player.diagnostics.counts["left_out"]) == ([], ["text"], 2)


def test_bag_with_wrong_metadata_plays_with_a_warning(start_node, text_bag, tmp_path, capfd):
    from lidar_perception.nodes.replay.bag_player import BagPlayer

    shutil.copytree(text_bag, tmp_path / "bag")
    metadata = yaml.safe_load((text_bag / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"].update(
        starting_time={"nanoseconds_since_epoch": START + 10 * STEP}, duration={"nanoseconds": 5}, storage_identifier=""
    )
    (tmp_path / "bag/metadata.yaml").write_text(yaml.safe_dump(metadata))
    player = start_node(BagPlayer, bag=str(tmp_path / "bag"), rate=100.0)
    player.serve = lambda timeout_sec: None
    player._play_once()
    assert len(player.sent["text"]) == 20
    warning = "metadata.yaml does not match the bag: it declares a start of"
    assert capfd.readouterr().err.count(warning) == 1


def test_topic_of_several_publishers_offers_the_strictest_qos():
    from lidar_perception.nodes.replay.bag_player import _make_qos

    def profile(reliability, durability):
        return SimpleNamespace(
            depth=1, reliability=SimpleNamespace(name=reliability), durability=SimpleNamespace(name=durability)
        )

    poor, good = profile("BEST_EFFORT", "VOLATILE"), profile("RELIABLE", "TRANSIENT_LOCAL")
    for profiles, best in (([poor], False), ([good], True), ([poor, good], True)):
        qos = _make_qos(profiles, 1, lossless=False)
        assert (qos.reliability.name, qos.durability.name) == (
            ("RELIABLE", "TRANSIENT_LOCAL") if best else ("BEST_EFFORT", "VOLATILE")
        )


def test_pause_step_resume_and_rate_take_effect(processes, peer, text_bag):
    messages = peer.listen("/text", TEXT)
    start(processes, text_bag, start_paused=True, rate=0.02)  # the remaining messages would take 85 s
    request = Trigger.Request()
    for expected in (["0"], ["0", "1"], ["0", "1", "2"]):
        assert peer.call("/bag_player/step", Trigger, request).success
        peer.wait(lambda n=len(expected): len(messages) >= n, "the stepped message")
        assert get_texts(messages) == expected
    assert peer.call("/bag_player/resume", Trigger, request).success
    assert not peer.call("/bag_player/step", Trigger, request).success  # only while paused
    peer.set_parameter("/bag_player", "rate", 5.0)
    peer.wait(lambda: len(messages) == 20, "the rest")
    assert get_texts(messages) == [str(i) for i in range(20)]


def test_bag_time_follows_the_rate_and_stops_while_paused(monkeypatch):
    from lidar_perception.nodes.replay import bag_player
    from lidar_perception.params import PlayerParams

    player = bag_player.BagPlayer.__new__(bag_player.BagPlayer)
    player.now_ns, player.last_advance, player.is_paused, player.clock = START, 50.0, False, None
    player.params = PlayerParams(rate=2.5)
    monkeypatch.setattr(bag_player, "monotonic", lambda: 54.0)
    player._advance()
    assert player.now_ns == START + 10 * 10**9
    player.is_paused = True
    monkeypatch.setattr(bag_player, "monotonic", lambda: 99.0)
    player._advance()
    player.is_paused, player.params = False, PlayerParams(rate=0.5)
    monkeypatch.setattr(bag_player, "monotonic", lambda: 101.0)
    player._advance()
    assert player.now_ns == START + 11 * 10**9


def test_clock_keeps_its_rate_between_rare_messages(monkeypatch):
    from lidar_perception.nodes.replay import bag_player
    from lidar_perception.params import PlayerParams

    player, now, sent = bag_player.BagPlayer.__new__(bag_player.BagPlayer), [50.0], []
    player.now_ns, player.last_advance, player.is_paused, player.steps = START, now[0], False, 0
    player.params, player.next_clock = PlayerParams(clock_hz=100.0), 0.0
    player.clock, player.stop = SimpleNamespace(publish=sent.append), Future()
    monkeypatch.setattr(bag_player, "monotonic", lambda: now[0])

    def serve(timeout_sec):
        now[0] += timeout_sec + 1e-4

    player.serve = serve
    assert player._wait_until(START + 10**9, "/text")
    assert 99 <= len(sent) <= 102


def test_clock_follows_a_looped_bag(processes, peer, text_bag):
    messages, clock = peer.listen("/text", TEXT), peer.listen("/clock", "rosgraph_msgs/msg/Clock")
    start(processes, text_bag, loop=True, rate=3.0, clock_hz=200.0)
    peer.wait(lambda: len(messages) > 45, "two and a half rounds")
    numbers = np.array(get_texts(messages), int)
    restarts = np.flatnonzero(np.diff(numbers) < 0)  # so that even a busy subscriber notices every round
    assert 2 <= len(restarts) <= 3 and (np.diff(numbers) != 0).all()
    assert (numbers[restarts] > 14).all() and (numbers[restarts + 1] < 5).all()
    times = np.array([to_ns(c.clock) for c in clock])
    assert (times >= START).all() and (times <= START + 25 * STEP).all()
    back = np.diff(times) < 0
    assert 1 <= back.sum() <= 3  # jumps back once per round


def test_player_waits_for_subscribers(processes, peer, text_bag):
    start(processes, text_bag, wait_for=["/text:=2"], rate=1.0)  # the player keeps ten for late subscribers
    first = peer.listen("/text", TEXT)
    peer.wait(lambda: peer.get_value("bag_player", "subscribers of /text") == "1", "one subscriber")
    assert first == []
    second = peer.listen("/text", TEXT)
    peer.wait(lambda: len(first) == 20 and len(second) == 20, "all messages at both")


def test_player_waits_until_a_subscriber_is_matched(processes, peer, text_bag):
    """The player discovers a subscriber before the publishing node does; messages sent in between would be
    lost."""
    me = peer.node.get_name()
    between = f"/{me}/output/between"
    diagnostics = peer.advertise("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    peer.advertise(f"/{me}/debug/processing_time_ms", "std_msgs/msg/Float64")
    peer.advertise(between, TEXT)
    peer.listen(between, TEXT)
    messages = peer.listen("/text", TEXT)

    def tell(count, until, what):
        peer.send(
            diagnostics,
            DiagnosticArray(
                status=[DiagnosticStatus(name=me, values=[KeyValue(key=f"subscribers of {between}", value=count)])]
            ),
            until,
            what,
        )

    start(processes, text_bag, wait_for=["/text", between], rate=1.0)
    peer.wait(lambda: peer.get_value("bag_player", "subscribers of /text") == "1", "the player")
    peer.diagnostics.clear()
    tell("0", lambda: "bag_player" in peer.diagnostics, "the player's next diagnostic")
    assert peer.get_message("bag_player") == WAITING and messages == []
    tell("1", lambda: len(messages) == 20, "all messages")


BAD = {
    "nothing": ({"bag": ""}, "'bag' is empty"),
    "nowhere": ({"bag": "/nowhere"}, "the bag /nowhere does not exist"),
    "topic": ({"topics": ["/other"]}, "no topic /other"),
    "remap": ({"remap": ["/text"]}, "OLD:=NEW"),
    "bad_name": ({"remap": ["/text:=a b"]}, "'a b' is not a valid topic name"),
    "no_name": ({"remap": ["/text:="]}, "'' is not a valid topic name"),
    "wait_for": ({"wait_for": ["/text:=x"]}, "must be TOPIC or TOPIC:=COUNT"),
    "offset": ({"start_offset": 60.0}, "start_offset 60 s is past the end"),
    "types": ({"remap": [f"{POINTS}:={TRUTH}"]}, "would have the types"),
    "rate": ({"rate": -1.0}, "rate"),
    "truncated": ({}, "truncated"),
}


@pytest.fixture(scope="module")
def failed_players(shared_processes, text_bag, drive_bag, tmp_path_factory):
    """Start one player per case in its own namespace; return the players and the truncated bag."""
    truncated_bag = tmp_path_factory.mktemp("cut") / "texts"
    shutil.copytree(text_bag, truncated_bag)
    storage = next(truncated_bag.glob("*.mcap"))
    storage.write_bytes(storage.read_bytes()[:-300])
    for case, (bad, _) in BAD.items():
        bag = {"truncated": truncated_bag, "types": drive_bag}.get(case, text_bag)
        shared_processes.start("bag_player", {}, {"bag": str(bag), **bad}, namespace=case)
    return truncated_bag


@pytest.mark.parametrize("case", BAD)
def test_unplayable_bag_logs_one_line_and_exits_with_2(failed_players, shared_processes, case):
    assert shared_processes.running[f"{case}.bag_player"].wait(timeout=60) == 2
    log = shared_processes.read_log(f"{case}.bag_player")
    assert BAD[case][1] in log.splitlines()[-1] and "Traceback" not in log
    assert case != "truncated" or str(failed_players) in log


def test_recorder_writes_the_played_messages(processes, peer, text_bag, tmp_path):
    processes.start(
        "bag_recorder", {}, {"bag": str(tmp_path / "copy"), "compression": "lz4", "topics": ["/text", "/note"]}
    )
    start(processes, text_bag, rate=2.0)  # the player keeps ten for late subscribers
    peer.wait(
        lambda: processes.has_ended("bag_player") and peer.get_value("bag_recorder", "frames") == "21",
        "21 recorded messages",
    )
    assert processes.stop()["bag_recorder"] == 0
    with Bag(tmp_path / "copy") as bag:
        assert [m.data for _, _, m in bag.messages({"/text"})] == [str(i) for i in range(20)]
        assert [m.data for _, _, m in bag.messages({"/note"})] == ["latched"]
        assert bag.find_qos("/note")[0].durability.name == "TRANSIENT_LOCAL"
    with open(tmp_path / "copy/copy.mcap", "rb") as stream:
        assert {c.compression for c in make_reader(stream).get_summary().chunk_indexes} == {"lz4"}


def test_looped_bag_of_one_message_does_not_busy_loop(monkeypatch, tmp_path):
    from lidar_perception.nodes.replay import bag_player
    from lidar_perception.params import PlayerParams

    player, now, sent, served = bag_player.BagPlayer.__new__(bag_player.BagPlayer), [50.0], [], []
    player.params, player.awaited_counts, player.clock = PlayerParams(loop=True), {}, None
    player.is_paused, player.steps, player.stop = False, 0, Future()
    player.last_service, player._count_pace = 0.0, lambda: None
    player.diagnostics = SimpleNamespace(report=lambda *_: None)
    player.pace = SimpleNamespace(wait_for_answers=lambda *_: None)
    player._wait_until_delivered = lambda: None
    monkeypatch.setattr(bag_player, "monotonic", lambda: now[0])

    def play():
        player.now_ns, player.last_advance = START, now[0]
        for late in range(200):  # a rate that is too high has the same effect
            if not player._wait_until(START - late, "/text"):
                return
            sent.append(now[0])
            now[0] += 0.001

    def serve(timeout_sec):
        served.append(now[0])
        now[0] += timeout_sec + 1e-5
        if now[0] > 60:
            player.stop.set_result(None)

    player._play_once = play
    player.spin(SimpleNamespace(spin_once=serve))
    assert np.diff(served).max() < 0.06
    player._play_once, player.stop, sent = lambda: sent.append(now[0]), Future(), []
    now[0] = 50.0
    player.spin(SimpleNamespace(spin_once=serve))
    assert 90 < len(sent) < 110  # ten per second
