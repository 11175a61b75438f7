"""metadata.yaml of a rosbag2 folder, versions 1 to 9, which is often incomplete or wrong.

It is edited by hand, made again by `ros2 bag reindex` and left over from other files. So only the
names of the files and the QoS are taken from it; the rest is compared with what the files hold.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import yaml

from lidar_perception.runs.files import read_text
from lidar_perception.types import InputError

NAME = "metadata.yaml"
MAX_BYTES = 2**26
TOLERANCE_NS = 10**6  # of times
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # faster, where it was built


@dataclass
class Metadata:
    """The readable part of a metadata.yaml.

    files: names of the storage files. topics: name -> (type, number of messages). qos: offered
    profiles of topics, as text or parsed. start_ns, duration_ns: None if it does not say them.
    compression: format of compressed files or messages, "" without. problems: one sentence per
    error in it.
    """

    files: list[str] = field(default_factory=list)
    topics: dict[str, tuple[str, int]] = field(default_factory=dict)
    qos: dict[str, Any] = field(default_factory=dict)
    start_ns: int | None = None
    duration_ns: int | None = None
    compression: str = ""
    problems: list[str] = field(default_factory=list)


def read_metadata(folder: Path) -> Metadata:
    """Read the metadata.yaml of a folder; an empty Metadata if there is none, or `folder` is a
    file."""
    metadata, path = Metadata(), folder / NAME
    if not path.is_file():
        return metadata
    try:
        content = yaml.load(read_text(path, MAX_BYTES), _Loader)
        info = content["rosbag2_bagfile_information"]
        metadata.files = [PurePath(name).name for name in info["relative_file_paths"]]
        if str(info.get("compression_mode") or "none").lower() != "none":
            metadata.compression = str(info.get("compression_format") or "")
        metadata.start_ns = _number(info, "starting_time", "nanoseconds_since_epoch")
        metadata.duration_ns = _number(info, "duration", "nanoseconds")
        for topic in info["topics_with_message_count"] or ():
            about = topic["topic_metadata"]
            if not isinstance(about["name"], str) or not isinstance(about["type"], str):
                raise ValueError(f"a topic {about['name']!r} of type {about['type']!r}")
            metadata.topics[about["name"]] = about["type"], _number(topic, "message_count")
            metadata.qos[about["name"]] = about.get("offered_qos_profiles")
    except (InputError, yaml.YAMLError, LookupError, TypeError, ValueError,
            AttributeError) as error:
        line = " ".join(str(error).split())
        metadata.problems.append(f"it is not readable ({type(error).__name__}: {line})")
    return metadata


def compare(metadata: Metadata, counts: Mapping[str, int], start_ns: int, duration_ns: int) -> None:
    """Add to metadata.problems where it differs from the number of messages by topic, and the
    times, of the files."""
    for topic, (_, count) in metadata.topics.items():
        if count != counts.get(topic, 0):
            metadata.problems.append(f"it says {count} messages on {topic}, and there are "
                                     f"{counts.get(topic, 0)}")
    for what, said, is_ in (("start", metadata.start_ns, start_ns),
                            ("duration", metadata.duration_ns, duration_ns)):
        if any(counts.values()) and said is not None and abs(said - is_) > TOLERANCE_NS:
            metadata.problems.append(f"it says a {what} of {said / 1e9:.3f} s, and it is "
                                     f"{is_ / 1e9:.3f} s")


def _number(tree: Mapping[str, Any], *keys: str) -> int:
    for key in keys:
        tree = tree[key]
    if isinstance(tree, int):
        return tree
    raise ValueError(f"{tree!r} for {' '.join(keys)}")
