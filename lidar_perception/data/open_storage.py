"""Functions that find and open the storage files of a bag."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

import zstandard

from lidar_perception.data import mcap_file, ros1_bag, sqlite_file
from lidar_perception.data.bag_metadata import METADATA_FILE, Metadata
from lidar_perception.data.mcap_file import McapFile
from lidar_perception.data.ros1_bag import Ros1File
from lidar_perception.data.sqlite_file import SqliteFile
from lidar_perception.data.storage import StorageFile
from lidar_perception.runs.files import check_regular, shorten_error
from lidar_perception.types import InputError
from lidar_perception.wire.compression import ZSTD_MAGIC

# Suffix of a storage file -> magic bytes, reader and recovery command.
FORMATS: dict[str, tuple[bytes, Callable[[Path], StorageFile], str]] = {
    ".mcap": (mcap_file.MAGIC, McapFile, "mcap recover"),
    ".db3": (sqlite_file.MAGIC, SqliteFile, "sqlite3 FILE .recover"),
    ".bag": (ros1_bag.MAGIC, Ros1File, "rosbag reindex"),
}
COMPRESSED_SUFFIX = ".zstd"  # suffix of files compressed by rosbag2
SUPPORTED = "give the folder of a rosbag2 bag, an .mcap, a .db3 or a ROS 1 .bag file"


def list_storage_files(folder: Path) -> list[Path]:
    """Return the storage files in a folder, sorted by name; [] if the folder does not exist."""
    if not folder.is_dir():
        return []
    return sorted(file for file in folder.iterdir() if _suffix(file) in FORMATS and not file.is_dir())


def find_files(path: Path, metadata: Metadata) -> list[Path]:
    """Return the storage files of a bag.

    These are the files listed in metadata.yaml. Without it, they are the files in the folder if
    their names show that they are parts of one bag. Differences are added to metadata.problems.

    Raises:
        InputError: the folder has no bag, or several.
    """
    if not path.exists():
        raise InputError(f"the bag {path} does not exist")
    if not path.is_dir():
        return [check_regular(path)]
    if metadata.compression not in ("", "zstd"):
        raise InputError(
            f"{path} is compressed by {metadata.compression}, which is not "
            "supported; decompress it with 'ros2 bag convert'"
        )
    for file in path.iterdir():
        check_regular(file)
    existing_files = list_storage_files(path)
    if not (path / METADATA_FILE).exists():
        if len(existing_files) == 1 or (existing_files and _are_parts_of_one_bag(existing_files)):
            return existing_files
        raise InputError(
            f"{path} is not a rosbag2 bag: it has no metadata.yaml and {len(existing_files)} "
            "storage files; run 'ros2 bag reindex' or give one .mcap file"
        )
    missing_names = [name for name in metadata.files if not (path / name).is_file()]
    if not missing_names and metadata.files:
        return [path / name for name in metadata.files]
    if not existing_files:
        raise InputError(
            f"the bag {path} is truncated or damaged: its metadata.yaml lists "
            f"{', '.join(missing_names) or 'no file'}, but the folder has no storage file; copy "
            "the folder again"
        )
    if missing_names:
        metadata.problems.append(
            f"it lists {', '.join(missing_names)} instead of {', '.join(file.name for file in existing_files)}"
        )
    return existing_files


def open_file(path: Path, stack: ExitStack) -> StorageFile:
    """Open a storage file, which the stack closes. Raises InputError if it is damaged."""
    try:
        source = _decompress(path, stack) if _read_head(path).startswith(ZSTD_MAGIC) else path
        head = _read_head(source)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    suffix = next((s for s, (magic, *_) in FORMATS.items() if head.startswith(magic)), "")
    if not suffix:
        if _suffix(path) not in FORMATS:
            raise InputError(f"{path} is not a bag; {SUPPORTED}")
        raise InputError(describe_damage(path, "its first bytes are wrong" if head else "it is empty"))
    try:
        file = stack.enter_context(closing(FORMATS[suffix][1](source)))
        for topic in file.topics:
            if not all(isinstance(text, str) for text in (topic.name, topic.type, topic.encoding)):
                raise ValueError(f"topic {topic.name!r} has the type {topic.type!r}")
        # Some writers omit "msg" in types, or the encoding of ROS 2 messages.
        file.topics = [
            topic._replace(type=re.sub(r"^(\w+)/(\w+)$", r"\1/msg/\2", topic.type), encoding=topic.encoding or "cdr")
            for topic in file.topics
        ]
        if file.times and not all(isinstance(time, int) for time in file.times):
            raise ValueError(f"{file.times!r} are not times in nanoseconds")
    except Exception as error:  # struct, SQLite, mcap and rosbags raise their own types
        raise InputError(describe_damage(path, error)) from None
    if isinstance(file, McapFile) and (problem := _diagnose_foreign_mcap(path, file)):
        raise InputError(problem)
    return file


def describe_damage(path: Path, error: Exception | str) -> str:
    """Return the error message for a damaged bag, with the reason and the remedy."""
    reason = error if isinstance(error, str) else shorten_error(error).rstrip(".")
    remedy = FORMATS.get(_suffix(path), FORMATS[".mcap"])[-1]
    return f"the bag {path} is truncated or damaged ({reason}); '{remedy}' may recover messages"


def _suffix(path: Path) -> str:
    return Path(path.stem).suffix if path.suffix == COMPRESSED_SUFFIX else path.suffix


def _read_head(path: Path) -> bytes:
    with open(path, "rb") as stream:
        return stream.read(16)


def _are_parts_of_one_bag(files: list[Path]) -> bool:
    """Return True if all files are ROS 1 bags, or are named like the parts of one rosbag2 bag."""
    names = {re.sub(r"_\d+(?=\.(mcap|db3)(\.zstd)?$)", "", file.name) for file in files}
    return all(file.suffix == ".bag" for file in files) or len(names) == 1


def _decompress(path: Path, stack: ExitStack) -> Path:
    """Decompress a file to a temporary file, which the stack removes, and return its path."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    target = folder / path.name.removesuffix(COMPRESSED_SUFFIX)
    try:
        decompressor = zstandard.ZstdDecompressor()
        with (
            open(path, "rb") as compressed,
            open(target, "wb") as copy,
            decompressor.stream_reader(compressed, read_across_frames=True) as stream,
        ):
            shutil.copyfileobj(stream, copy, 2**20)
    except OSError as error:
        raise InputError(
            f"cannot decompress {path} to {folder}: {error.strerror}; set TMPDIR to a folder with more space"
        ) from None
    except zstandard.ZstdError as error:
        raise InputError(describe_damage(path, error)) from None
    return target


def _diagnose_foreign_mcap(path: Path, file: McapFile) -> str:
    """Return an error message for an MCAP file without ROS 2 messages; "" if it has some."""
    encodings = {topic.encoding for topic in file.topics}
    if file.profile == "ros2" or "cdr" in encodings:
        return ""
    if file.profile == "ros1" or "ros1" in encodings:
        return f"{path} is an MCAP file with ROS 1 messages; give the .bag file that it was converted from"
    return (
        f"{path} is an MCAP file without ROS 2 messages (profile {file.profile!r}), for example "
        "from Foxglove; give clouds as sensor_msgs/PointCloud2 in a ROS 2 bag"
    )
