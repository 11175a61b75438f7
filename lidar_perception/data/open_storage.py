"""Find the storage files of a bag, and open each by its content."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import zstandard

from lidar_perception.data import mcap_file, ros1_bag, sqlite_file
from lidar_perception.data.bag_metadata import NAME, Metadata
from lidar_perception.data.mcap_file import McapFile
from lidar_perception.data.ros1_bag import Ros1File
from lidar_perception.data.sqlite_file import SqliteFile
from lidar_perception.data.storage import StorageFile
from lidar_perception.runs.files import regular, short
from lidar_perception.types import InputError
from lidar_perception.wire.compression import ZSTD_MAGIC

# Suffix -> how such a file begins, what opens it, and what may mend a damaged one.
FORMATS: dict[str, tuple[bytes, Callable[[Path], StorageFile], str]] = {
    ".mcap": (mcap_file.MAGIC, McapFile, "mcap recover"),
    ".db3": (sqlite_file.MAGIC, SqliteFile, "sqlite3 FILE .recover"),
    ".bag": (ros1_bag.MAGIC, Ros1File, "rosbag reindex"),
}
PACKED = ".zstd"  # suffix of the files that rosbag2 compressed
WANTED = "give the folder of a rosbag2 bag, an .mcap, a .db3 or a ROS 1 .bag file"


def storage_files(folder: Path) -> list[Path]:
    """Return the files in a folder that are named as storage files of a bag, by name; none where
    there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(file for file in folder.iterdir()
                  if _suffix(file) in FORMATS and not file.is_dir())


def find_files(path: Path, metadata: Metadata) -> list[Path]:
    """Return the storage files of the bag at a path: those that metadata.yaml names, or without one
    those that belong together by their names. Adds to metadata.problems where it names others than
    there are. InputError where there is no bag, or where it is not clear which one is meant."""
    if not path.exists():
        raise InputError(f"there is no bag {path}")
    if not path.is_dir():
        return [regular(path)]
    if metadata.compression not in ("", "zstd"):
        raise InputError(f"{path} is compressed by {metadata.compression}, which is not read; "
                         "decompress it with 'ros2 bag convert'")
    for file in path.iterdir():
        regular(file)
    found = storage_files(path)
    if not (path / NAME).exists():
        if len(found) == 1 or (found and _belong_together(found)):
            return found
        raise InputError(f"{path} has no metadata.yaml and {len(found)} storage files, so it is no "
                         "rosbag2 bag; run 'ros2 bag reindex' or give one .mcap file")
    missing = [name for name in metadata.files if not (path / name).is_file()]
    if not missing and metadata.files:
        return [path / name for name in metadata.files]
    if not found:
        raise InputError(f"the bag {path} is truncated or damaged: its metadata.yaml names "
                         f"{', '.join(missing) or 'no file'}, and there is no storage file; copy "
                         "the whole folder again")
    if missing:
        metadata.problems.append(f"it names {', '.join(missing)}, and there is "
                                 f"{', '.join(file.name for file in found)}")
    return found


def open_file(path: Path, stack: ExitStack) -> StorageFile:
    """Open a storage file until the stack is closed. InputError where it is damaged, or none."""
    try:
        source = _unpacked(path, stack) if _head(path).startswith(ZSTD_MAGIC) else path
        head = _head(source)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    suffix = next((s for s, (magic, *_) in FORMATS.items() if head.startswith(magic)), "")
    if not suffix:
        if _suffix(path) not in FORMATS:
            raise InputError(f"{path} is no bag; {WANTED}")
        raise InputError(damaged(path, "it does not begin as such a file does" if head
                                 else "it is empty"))
    try:
        file = stack.enter_context(closing(FORMATS[suffix][1](source)))
        for topic in file.topics:
            if not all(isinstance(text, str) for text in (topic.name, topic.type, topic.encoding)):
                raise ValueError(f"it names a topic {topic.name!r} of type {topic.type!r}")
        # Some writers leave out "msg" or the encoding, which is then that of ROS 2.
        file.topics = [topic._replace(type=re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", topic.type),
                                      encoding=topic.encoding or "cdr") for topic in file.topics]
        if file.times and not all(isinstance(time, int) for time in file.times):
            raise ValueError(f"it has {file.times!r} for times in nanoseconds")
    except Exception as error:  # struct, SQLite, mcap and rosbags raise their own
        raise InputError(damaged(path, error)) from None
    if isinstance(file, McapFile) and (problem := _foreign(path, file)):
        raise InputError(problem)
    return file


def damaged(path: Path, error: Exception | str) -> str:
    """Return the message of a bag that is damaged, with the reason and the remedy."""
    reason = error if isinstance(error, str) else short(error).rstrip(".")
    remedy = FORMATS.get(_suffix(path), FORMATS[".mcap"])[-1]
    return f"the bag {path} is truncated or damaged ({reason}); '{remedy}' may save what it holds"


def _suffix(path: Path) -> str:
    return Path(path.stem).suffix if path.suffix == PACKED else path.suffix


def _head(path: Path) -> bytes:
    with open(path, "rb") as stream:
        return stream.read(16)


def _belong_together(files: list[Path]) -> bool:
    """Return True if all files are ROS 1 bags, or named as rosbag2 names the parts of one."""
    names = {re.sub(r"_\d+(?=\.(mcap|db3)(\.zstd)?$)", "", file.name) for file in files}
    return all(file.suffix == ".bag" for file in files) or len(names) == 1


def _unpacked(path: Path, stack: ExitStack) -> Path:
    """Return an unpacked copy of a file, which is removed when the stack is closed."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    target = folder / path.name.removesuffix(PACKED)
    try:
        with open(path, "rb") as packed, open(target, "wb") as whole, \
                zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True) as data:
            shutil.copyfileobj(data, whole, 2**20)
    except OSError as error:
        raise InputError(f"cannot unpack {path} into {folder}: {error.strerror}; set TMPDIR to a "
                         "folder with more space") from None
    except zstandard.ZstdError as error:
        raise InputError(damaged(path, error)) from None
    return target


def _foreign(path: Path, file: McapFile) -> str:
    """Return the error for an MCAP file without a message of ROS 2; "" if it has some."""
    encodings = {topic.encoding for topic in file.topics}
    if file.profile == "ros2" or "cdr" in encodings:
        return ""
    if file.profile == "ros1" or "ros1" in encodings:
        return f"{path} has messages of ROS 1 in MCAP; give the .bag that it was made of"
    return (f"{path} is MCAP but no bag of ROS 2 (profile {file.profile!r}), as Foxglove and "
            "others write it; give clouds as sensor_msgs/PointCloud2 in a bag of ROS 2")
