"""Reader of point cloud files (.pcd, .ply, .npy, .bin) with all their columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lidar_perception.data.nuscenes.folder import SWEEP_COLUMNS
from lidar_perception.data.pcd import read_pcd
from lidar_perception.data.ply import read_ply
from lidar_perception.data.recorded_scale import make_scale_reader
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import check_regular, shorten_error
from lidar_perception.types import MAX_RANGE, InputError, PointCloud
from lidar_perception.wire.codec import make_bag_message
from lidar_perception.wire.messages import read_raw_intensity, to_point_cloud
from msg_utils.point_cloud2 import from_array, read_xyz
from msg_utils.stamps import make_header

KITTI_COLUMNS = "x y z intensity"
MAX_COLUMNS = 16  # maximum number of columns of a .npy file; an array with more is probably transposed
MAX_RING = 256  # upper limit of the ring numbers in a .bin file with five columns
SAMPLE_SIZE = 2000  # number of points from which the columns of a .bin file are inferred
MAX_NEGATIVE_FRACTION = 0.1  # maximum fraction of negative intensities if the assumed columns are right
REFLECTANCE = ("reflectance", "remission")  # other names for the intensity


def is_cloud(path: Path) -> bool:
    """Return True for a file with one of SUFFIXES, in upper or lower case."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def make_cloud_scale_reader(files: Sequence[Path]) -> Callable[[], float]:
    """Return a function that infers the intensity scale of point cloud files, see make_scale_reader."""
    return make_scale_reader(files, lambda file: read_raw_intensity(to_message(file)))


def load_points(file: Path, stamp_ns: int, frame_id: str = "", *, scale: Callable[[], float]) -> PointCloud:
    """Read the usable points of a file with one of SUFFIXES.

    Args:
        scale: returns the intensity of a full reflection (see make_cloud_scale_reader).

    Raises:
        InputError: the file is malformed, or all points are beyond MAX_RANGE, for example in map
            coordinates (UTM).
    """
    try:
        message = to_message(file, stamp_ns, frame_id)
        frame = to_point_cloud(message, scale())[0]
    except InputError as error:
        raise InputError(str(error) if str(file) in str(error) else f"{file}: {error}") from None
    if len(frame) == 0:
        check_range(read_points(file), file)
    return frame


def check_range(points: np.ndarray, source: object) -> None:
    """Raise InputError if all finite points are beyond MAX_RANGE.

    Args:
        points: structured array with x, y and z.
        source: name of the cloud in the error message.
    """
    coordinates = read_xyz(points)
    max_coordinates = np.abs(coordinates[np.isfinite(coordinates).all(axis=1)]).max(axis=1, initial=0)
    if len(max_coordinates) and max_coordinates.min() > MAX_RANGE / 2:
        x, y = (round(float(points[axis][0]), -3) for axis in "xy")
        raise InputError(
            f"{source}: all points are beyond {MAX_RANGE / 1000:g} km, so they are probably in "
            f"map coordinates (UTM); subtract an offset, such as {x:.0f} {y:.0f}, "
            "from x y and save the cloud again"
        )


def to_message(file: Path, stamp_ns: int = 0, frame_id: str = "") -> Any:
    """Read a file as a PointCloud2 (class of rosbags) with all its columns."""
    points = read_points(file)
    # PointCloud2 has no 64-bit integers. Times keep their microseconds as float64.
    fields = [
        (name, points.dtype[name].base.str.replace("i8", "f8").replace("u8", "f8"), points.dtype[name].shape)
        for name in points.dtype.names or ()
    ]
    try:
        return from_array(points.astype(fields), make_header(stamp_ns, frame_id, make_bag_message), make_bag_message)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None


def read_points(file: Path) -> np.ndarray:
    """Read a file with one of SUFFIXES as a structured array (N,) with all columns.

    Column names are converted to lower case, CloudCompare's prefix "scalar_" is removed, and the
    names in REFLECTANCE become "intensity". Raises InputError if the file cannot be read, or lacks
    x, y or z.
    """
    points = _rename_columns(READERS[file.suffix.lower()](file))
    if missing_fields := {"x", "y", "z"} - set(points.dtype.names or ()):
        raise InputError(f"{file} has no field {min(missing_fields)}, so it is not a point cloud")
    return points


def _rename_columns(points: np.ndarray) -> np.ndarray:
    names = points.dtype.names or ()
    new_names = [name.lower().removeprefix("scalar_") for name in names]
    synonym = next((name for name in REFLECTANCE if name in new_names), "")
    if "intensity" not in new_names and synonym:
        new_names[new_names.index(synonym)] = "intensity"
    new_names = [name if new_names.count(name) == 1 else old for name, old in zip(new_names, names)]
    fields = [points.dtype.fields[name] for name in names] if points.dtype.fields else []
    return points.view(
        np.dtype(
            {
                "names": new_names,
                "formats": [field[0] for field in fields],
                "offsets": [field[1] for field in fields],
                "itemsize": points.dtype.itemsize,
            }
        )
    )


def read_npy(file: Path) -> np.ndarray:
    """Read a .npy file: (N, 3) [x y z], (N, 4) [x y z intensity] or more, or a structured array.

    Returns:
        (N,) structured array with the first four columns, or with all fields of a structured array.

    Raises:
        InputError: the file cannot be read, or the array has a wrong shape or type.
    """
    try:
        array = np.array(np.load(check_regular(file), mmap_mode="r", allow_pickle=False))
    except Exception as error:  # the header is Python source, so parsing raises errors of many types
        raise InputError(
            f"{file} is not a readable .npy file ({shorten_error(error)}); save it again with numpy.save"
        ) from None
    if array.dtype.names:
        return array.reshape(-1)
    if array.ndim != 2 or not 3 <= array.shape[1] <= MAX_COLUMNS or array.dtype.kind != "f":
        raise InputError(
            f"{file} has an array {array.shape} of {array.dtype}; expected (N, 3) "
            "x y z or (N, 4) x y z intensity as float32"
        )
    dtype = np.float64 if array.dtype.itemsize == 8 else np.float32
    return _to_structured(array[:, :4].astype(dtype), KITTI_COLUMNS)


def _read_bin(file: Path) -> np.ndarray:
    """Read a .bin file of float32 with KITTI's four columns, or nuScenes' five (the last is ring).

    The number of columns is inferred from the values. Raises InputError if neither number fits.
    """
    if file.stat().st_size % 20 == 0:
        cloud = read_records(file, SWEEP_COLUMNS)
        ring = cloud[:SAMPLE_SIZE, 4]
        with np.errstate(invalid="ignore"):
            if ((ring >= 0) & (ring < MAX_RING) & (ring == np.floor(ring))).all():
                return _to_structured(cloud, SWEEP_COLUMNS)
    cloud = read_records(file, KITTI_COLUMNS)
    intensity = cloud[:SAMPLE_SIZE, 3]
    if np.count_nonzero(intensity < 0) > MAX_NEGATIVE_FRACTION * len(intensity):
        raise InputError(
            f"{file} does not have the columns {KITTI_COLUMNS} or {SWEEP_COLUMNS} as float32, because many "
            "intensities would be negative; save the cloud as .pcd, which names its columns"
        )
    return _to_structured(cloud, KITTI_COLUMNS)


def _to_structured(cloud: np.ndarray, columns: str) -> np.ndarray:
    """View an array (N, C) as a structured array (N,) with the first C of the column names."""
    names = columns.split()[: cloud.shape[1]]
    return np.ascontiguousarray(cloud).view([(name, cloud.dtype) for name in names]).reshape(-1)


READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".npy": read_npy,
    ".bin": _read_bin,
}
SUFFIXES = tuple(READERS)
