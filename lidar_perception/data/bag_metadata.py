"""Reader of rosbag2's metadata.yaml, versions 1 to 9, and of QoS profiles.

The file is often incomplete or wrong: people edit it, `ros2 bag reindex` recreates it, and it may
describe other storage files. Therefore only file names and QoS are used from it, and the rest is
compared with the storage files.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

METADATA_FILE = "metadata.yaml"
MAX_BYTES = 2**26
TOLERANCE_NS = 10**6  # tolerated difference between times in metadata.yaml and in the files

# QoS profiles with the keys and values of rosbag2. Late subscribers of a latched topic get its last message.
SENSOR_QOS = dict(history="keep_last", depth=10, reliability="reliable", durability="volatile")
LATCHED_QOS = dict(history="keep_last", depth=1, reliability="reliable", durability="transient_local")

_INFINITE = {"sec": 9223372036, "nsec": 854775807}
_OTHER_POLICIES = {
    "deadline": _INFINITE,
    "lifespan": _INFINITE,
    "liveliness": "automatic",
    "liveliness_lease_duration": _INFINITE,
    "avoid_ros_namespace_conventions": False,
}
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # faster, but optional


@dataclass
class Metadata:
    """The valid content of a metadata.yaml.

    Attributes:
        files: names of the storage files.
        topics: type and number of messages of each topic, by its name.
        qos: offered profiles by topic, as YAML text or parsed.
        start_ns, duration_ns: start and duration of the bag; None if not given.
        compression: format of compressed files or messages; "" without compression.
        problems: errors in the file, one sentence each.
    """

    files: list[str] = field(default_factory=list)
    topics: dict[str, tuple[str, int]] = field(default_factory=dict)
    qos: dict[str, Any] = field(default_factory=dict)
    start_ns: int | None = None
    duration_ns: int | None = None
    compression: str = ""
    problems: list[str] = field(default_factory=list)


def read_metadata(folder: Path) -> Metadata:
    """Read the metadata.yaml of a bag folder; the result is empty if the file does not exist."""
    metadata, path = Metadata(), folder / METADATA_FILE
    if not path.is_file():
        return metadata
    try:
        content = yaml.load(read_text(path, MAX_BYTES), _Loader)
        info = content["rosbag2_bagfile_information"]
        metadata.files = [PurePath(name).name for name in info["relative_file_paths"]]
        if str(info.get("compression_mode") or "none").lower() != "none":
            metadata.compression = str(info.get("compression_format") or "")
        metadata.start_ns = _read_number(info, "starting_time", "nanoseconds_since_epoch")
        metadata.duration_ns = _read_number(info, "duration", "nanoseconds")
        for topic in info["topics_with_message_count"] or ():
            topic_info = topic["topic_metadata"]
            if not isinstance(topic_info["name"], str) or not isinstance(topic_info["type"], str):
                raise ValueError(f"topic {topic_info['name']!r} has the type {topic_info['type']!r}")
            metadata.topics[topic_info["name"]] = topic_info["type"], _read_number(topic, "message_count")
            metadata.qos[topic_info["name"]] = topic_info.get("offered_qos_profiles")
    except (InputError, yaml.YAMLError, LookupError, TypeError, ValueError, AttributeError) as error:
        line = " ".join(str(error).split())
        metadata.problems.append(f"it cannot be parsed ({type(error).__name__}: {line})")
    return metadata


def add_differences(metadata: Metadata, counts: Mapping[str, int], start_ns: int, duration_ns: int) -> None:
    """Compare the metadata with the message counts and times in the files; add differences to problems."""
    for topic, (_, count) in metadata.topics.items():
        if count != counts.get(topic, 0):
            metadata.problems.append(f"it declares {count} messages on {topic}, the files have {counts.get(topic, 0)}")
    for name, declared_ns, actual_ns in (
        ("start", metadata.start_ns, start_ns),
        ("duration", metadata.duration_ns, duration_ns),
    ):
        if any(counts.values()) and declared_ns is not None and abs(declared_ns - actual_ns) > TOLERANCE_NS:
            metadata.problems.append(
                f"it declares a {name} of {declared_ns / 1e9:.3f} s instead of {actual_ns / 1e9:.3f} s"
            )


def _read_number(tree: Mapping[str, Any], *keys: str) -> int:
    for key in keys:
        tree = tree[key]
    if isinstance(tree, int):
        return tree
    raise ValueError(f"{tree!r} for {' '.join(keys)}")


def complete_profile(qos: dict[str, Any]) -> dict[str, Any]:
    """Extend a profile such as SENSOR_QOS by the other policies that rosbag2 writes."""
    return {**qos, **_OTHER_POLICIES}


def parse_profiles(profiles: Any) -> list[Qos]:
    """Parse the profiles of a topic, given as YAML text or lists of dicts; return [] if they are invalid.

    Only history, depth, reliability and durability are read. Durations are ignored: nodes do not
    need them, and writers represent them in many ways (numbers, "infinite", left out).
    """
    try:
        profiles = yaml.safe_load(profiles) if isinstance(profiles, str) else profiles
        known_policies = [
            {key: profile[key] for key in SENSOR_QOS if isinstance(profile.get(key), str | int)}
            for profile in profiles or ()
        ]
        # rosbags requires all policies (rosbags/rosbag2/metadata.py, parse_qos).
        complete_profiles: Any = [complete_profile(SENSOR_QOS | policies) for policies in known_policies]
        return parse_qos(complete_profiles)
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        return []
