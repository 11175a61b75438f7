"""The points of one file: .pcd, .ply, .npy or .bin, with the columns that it has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from lidar_perception.data.nuscenes.folder import SWEEP
from lidar_perception.data.pcd import read_pcd
from lidar_perception.data.ply import read_ply
from lidar_perception.data.recorded_scale import recorded_scale
from lidar_perception.data.records import read_records
from lidar_perception.runs.files import regular, short
from lidar_perception.types import MAX_RANGE, InputError, LidarFrame
from lidar_perception.wire.codec import bag_message
from lidar_perception.wire.messages import read_raw_intensity, to_frame
from msg_utils.point_cloud2 import from_array, xyz
from msg_utils.stamps import header_message

KITTI = "x y z intensity"
MAX_COLUMNS = 16  # of a .npy file; more are a cloud on its side
MAX_RING = 256
SAMPLE = 2000  # points on which the columns of a .bin file are told
NEGATIVE = 0.1  # of them; where more have a negative intensity the columns are others
REFLECTANCE = ("reflectance", "remission")  # other names for the intensity


def is_cloud(path: Path) -> bool:
    """Return True for a file whose suffix, in any case, is one of SUFFIXES."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def cloud_scale(files: Sequence[Path]) -> Callable[[], float]:
    """Return the recorded_scale() of files of SUFFIXES."""
    return recorded_scale(files, lambda file: read_raw_intensity(to_message(file)))


def load_points(file: Path, stamp_ns: int, frame_id: str = "", *,
                scale: Callable[[], float]) -> LidarFrame:
    """Read the usable points of a file of SUFFIXES; scale() is the intensity of a full reflection,
    see cloud_scale.

    Raises: InputError for a broken file, and for a cloud all of which is beyond MAX_RANGE, as one
    in map coordinates (UTM) is.
    """
    try:
        message = to_message(file, stamp_ns, frame_id)
        frame = to_frame(message, scale())[0]
    except InputError as error:
        raise InputError(str(error) if str(file) in str(error) else f"{file}: {error}") from None
    if len(frame) == 0:
        check_near(read_points(file), file)
    return frame


def check_near(points: np.ndarray, where: object) -> None:
    """Raise InputError if every finite point of a structured array is beyond MAX_RANGE."""
    coordinates = xyz(points)
    far = np.abs(coordinates[np.isfinite(coordinates).all(axis=1)]).max(axis=1, initial=0)
    if len(far) and far.min() > MAX_RANGE / 2:
        x, y = (round(float(points[axis][0]), -3) for axis in "xy")
        raise InputError(f"{where}: all points are beyond {MAX_RANGE / 1000:g} km, as map "
                         f"coordinates (UTM) are; subtract an offset, such as {x:.0f} {y:.0f} from "
                         "x y, and save it again")


def to_message(file: Path, stamp_ns: int = 0, frame_id: str = "") -> Any:
    """Read a file as a PointCloud2 of rosbags' class, with all its columns."""
    points = read_points(file)
    # A PointCloud2 has no whole numbers of 64 bits: times as float64 keep their microseconds.
    kinds = [(name, points.dtype[name].base.str.replace("i8", "f8").replace("u8", "f8"),
              points.dtype[name].shape) for name in points.dtype.names or ()]
    try:
        return from_array(points.astype(kinds), header_message(stamp_ns, frame_id, bag_message),
                          bag_message)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None


def read_points(file: Path) -> np.ndarray:
    """Read a file of SUFFIXES.

    Returns: (N,) structured array with the columns of the file. Names are in lower case and without
    the "scalar_" of CloudCompare, and REFLECTANCE is called intensity.
    Raises: InputError for a file that cannot be read, or has no x, y or z.
    """
    points = _with_usual_names(READERS[file.suffix.lower()](file))
    if missing := {"x", "y", "z"} - set(points.dtype.names or ()):
        raise InputError(f"{file} has no field {min(missing)}; it is no cloud of points")
    return points


def _with_usual_names(points: np.ndarray) -> np.ndarray:
    names = points.dtype.names or ()
    new = [name.lower().removeprefix("scalar_") for name in names]
    if "intensity" not in new and (other := next((n for n in REFLECTANCE if n in new), "")):
        new[new.index(other)] = "intensity"
    new = [name if new.count(name) == 1 else old for name, old in zip(new, names)]
    fields = [points.dtype.fields[name] for name in names] if points.dtype.fields else []
    return points.view(np.dtype({"names": new, "formats": [field[0] for field in fields],
                                 "offsets": [field[1] for field in fields],
                                 "itemsize": points.dtype.itemsize}))


def read_npy(file: Path) -> np.ndarray:
    """Read a .npy file of an array (N, 3) [x y z], or (N, 4) and more [x y z intensity ...], or of
    a structured one.

    Returns: (N,) structured array; of more than four columns the first four.
    Raises: InputError for another shape or type.
    """
    try:
        array = np.array(np.load(regular(file), mmap_mode="r", allow_pickle=False))
    except (OSError, ValueError, EOFError, TypeError, LookupError, OverflowError, MemoryError,
            SyntaxError, TokenError, RecursionError) as error:  # the header is read as Python
        raise InputError(f"{file} is no .npy file that can be read ({short(error)}); save it again "
                         "with numpy.save") from None
    if array.dtype.names:
        return array.reshape(-1)
    if array.ndim != 2 or not 3 <= array.shape[1] <= MAX_COLUMNS or array.dtype.kind != "f":
        raise InputError(f"{file} has an array {array.shape} of {array.dtype}; expected (N, 3) "
                         "x y z or (N, 4) x y z intensity as float32")
    kind = np.float64 if array.dtype.itemsize == 8 else np.float32
    return _structured(array[:, :4].astype(kind), KITTI)


def _of_records(file: Path) -> np.ndarray:
    """A .bin file of float32: KITTI's four columns, or nuScenes' five, whose last is the ring.
    InputError where it has others: nothing in it says how many."""
    if file.stat().st_size % 20 == 0:
        cloud = read_records(file, SWEEP)
        ring = cloud[:SAMPLE, 4]
        with np.errstate(invalid="ignore"):
            if ((ring >= 0) & (ring < MAX_RING) & (ring == np.floor(ring))).all():
                return _structured(cloud, SWEEP)
    cloud = read_records(file, KITTI)
    intensity = cloud[:SAMPLE, 3]
    if np.count_nonzero(intensity < 0) > NEGATIVE * len(intensity):
        raise InputError(f"{file} is not of the columns {KITTI}, nor {SWEEP}, as float32: much of "
                         "the intensity would be negative; save it as .pcd, which names columns")
    return _structured(cloud, KITTI)


def _structured(cloud: np.ndarray, columns: str) -> np.ndarray:
    """(N, C) as (N,) with these names for its columns, as many as it has."""
    names = columns.split()[:cloud.shape[1]]
    return np.ascontiguousarray(cloud).view([(name, cloud.dtype) for name in names]).reshape(-1)


READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy, ".bin": _of_records}
SUFFIXES = tuple(READERS)
