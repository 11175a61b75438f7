"""Edited or damaged metadata.yaml of a bag."""

from __future__ import annotations

import shutil

import pytest
from bag_samples import copy_with_metadata, message_bytes

from lidar_perception.data.bag import Bag
from lidar_perception.data.open import open_recording
from lidar_perception.types import InputWarning
from lidar_perception.wire.topics import EXTRINSICS, POINTS

pytestmark = pytest.mark.usefixtures("no_warning")


def update_topics(info, **values):
    for topic in info["topics_with_message_count"]:
        topic["topic_metadata"].update(values)


@pytest.mark.parametrize(
    "change",
    [
        lambda info: info.update(storage_identifier=""),
        lambda info: info.pop("storage_identifier"),
        lambda info: info.update(storage_identifier="my_plugin"),
        lambda info: info.update(version=10),
        lambda info: info.update(version=1, relative_file_paths=["drive/drive.mcap"]),
        lambda info: [
            info.pop(key) for key in ("files", "custom_data", "ros_distro", "compression_format", "compression_mode")
        ],
        lambda info: info.update(files=[]),
        lambda info: info.update(topics_with_message_count=[]),
        lambda info: update_topics(info, offered_qos_profiles=""),
        lambda info: update_topics(info, offered_qos_profiles=[]),
        lambda info: update_topics(info, offered_qos_profiles="- history: [\n"),
        lambda info: update_topics(info, offered_qos_profiles="- infinite"),
        lambda info: update_topics(info, offered_qos_profiles=[{"deadline": "infinite"}]),
        lambda info: update_topics(info, type_description_hash="RIHS01_0", serialization_format=""),
    ],
)
def test_irrelevant_metadata_is_ignored(sample_bag, messages, tmp_path, change):
    path = copy_with_metadata(sample_bag, tmp_path / "bag", change)
    assert message_bytes(path) == messages
    assert len(open_recording(path)) == 3


@pytest.mark.parametrize(
    "text, durability, depth",
    [
        ("- history: 1\n  depth: 7\n  reliability: 2\n  durability: 1", "TRANSIENT_LOCAL", 7),
        (
            "- history: keep_last\n  depth: 7\n  reliability: best_effort\n  durability: volatile\n"
            "  deadline: {sec: 2147483647, nsec: 4294967295}\n  lifespan: infinite",
            "VOLATILE",
            7,
        ),
    ],
)
def test_qos_in_metadata_takes_precedence(sample_bag, tmp_path, text, durability, depth):
    path = copy_with_metadata(sample_bag, tmp_path / "bag", lambda info: update_topics(info, offered_qos_profiles=text))
    with Bag(path) as bag:
        (profile,) = bag.find_qos(POINTS)
        assert (profile.durability.name, profile.depth) == (durability, depth)
        assert profile.reliability.name == "BEST_EFFORT"
    path = copy_with_metadata(
        sample_bag, tmp_path / "other", lambda info: update_topics(info, offered_qos_profiles="nonsense")
    )
    with Bag(path) as bag:
        assert bag.find_qos(EXTRINSICS)[0].durability.name == "TRANSIENT_LOCAL"


def set_counts(info, count):
    for topic in info["topics_with_message_count"]:
        topic["message_count"] = count


@pytest.mark.parametrize(
    "change, words",
    [
        (
            lambda info: set_counts(info, 5),
            "it declares 5 messages on /camera/camera_info, the files have 2.*and 2 more",
        ),
        (lambda info: set_counts(info, -1), "it declares -1 messages"),
        (lambda info: set_counts(info, "1,5"), "'1,5' for message_count"),
        (lambda info: set_counts(info, 2.5), "2.5 for message_count"),
        (lambda info: update_topics(info, name=3), "topic 3 has the type"),
        (lambda info: update_topics(info, type=[1]), r"the type \[1\]"),
        (lambda info: info["duration"].update(nanoseconds=10**8), "a duration of 0.100 s instead of 0"),
        (lambda info: info["duration"].update(nanoseconds=10**30), "a duration of"),
        (lambda info: info["starting_time"].update(nanoseconds_since_epoch=0), "a start of 0.000 s"),
        (lambda info: info.pop("duration"), "KeyError: 'duration'"),
        (
            lambda info: info.update(relative_file_paths=["a.mcap", "b.mcap"]),
            "it lists a.mcap, b.mcap instead of drive.mcap",
        ),
        (lambda info: info.clear(), "KeyError: 'relative_file_paths'"),
    ],
)
def test_wrong_metadata_is_reported_in_one_warning(sample_bag, messages, tmp_path, change, words):
    path = copy_with_metadata(sample_bag, tmp_path / "bag", change)
    with pytest.warns(InputWarning, match=f"bag/metadata.yaml does not match the bag: .*{words}") as caught:
        recording = open_recording(path)
        assert [len(frame.load()) for frame in recording] == [len(frame.load()) for frame in open_recording(sample_bag)]
        recording.frames[2].load()
    assert len(caught) == 1 and "\n" not in str(caught[0].message)
    with pytest.warns(InputWarning), Bag(path) as bag:
        assert (bag.start_ns, bag.end_ns) == (messages[0][1], messages[-1][1] + 1)
        assert [*bag.raw_messages()] == messages


@pytest.mark.parametrize("text", ["text", "a: [\n", "", "\xff\x00"])
def test_unreadable_metadata_is_reported_in_a_warning(sample_bag, messages, tmp_path, text):
    shutil.copytree(sample_bag, tmp_path / "bag")
    (tmp_path / "bag/metadata.yaml").write_text(text, encoding="latin-1")
    with pytest.warns(InputWarning, match="cannot be parsed"):
        assert message_bytes(tmp_path / "bag") == messages
