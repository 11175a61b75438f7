"""Conversion between ROS messages (of rclpy or rosbags) and the types of the library."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from lidar_perception.camera import Calibration
from lidar_perception.classes import ID_BY_ALIAS, TABLE
from lidar_perception.groups import renumber_ids
from lidar_perception.intensity import INTENSITY_FIELDS, find_scale_problem, infer_full_scale, to_unit
from lidar_perception.robot import poses
from lidar_perception.types import (
    CLASSES,
    Detections,
    GroundTruth,
    InputError,
    PointCloud,
    are_usable_returns,
    find_class_ids,
)
from lidar_perception.wire.topics import CAMERA_FRAME
from msg_utils.markers import MarkedObjects, MarkerRow, make_marker_rows, to_marker_array
from msg_utils.point_cloud2 import CloudError, from_array, read_columns, read_xyz, to_array
from msg_utils.stamps import to_ns

# Values of the column in_view: segmented, and in view but not segmented because no detector uses the point.
IN_VIEW, OUT_OF_RANGE = 1, 2
MAX_ID = 2**31  # marker ids are int32
DETECTION_COVARIANCES = np.array(  # (C, 6, 6) by class, see make_pose_covariances
    [
        np.diag(np.square((xy, xy, z, 0.0, 0.0, yaw)))
        for xy, z, yaw in (row.numbers.deviations if row.numbers else (0.0, 0.0, 0.0) for row in TABLE)
    ]
)
FullScale = Callable[[np.ndarray, DTypeLike], float]  # see intensity.infer_full_scale


def to_point_cloud(
    msg: Any, intensity_max: float | None = None, scale: FullScale = infer_full_scale
) -> tuple[PointCloud, np.ndarray]:
    """Convert a PointCloud2 to a PointCloud of its usable points.

    If the cloud has a column `in_view`, points where it is 0 are left out.

    Args:
        intensity_max: Intensity of a full reflection; 0: inferred by `scale`; None: do not read the
            intensity.
        scale: Function that infers the intensity of a full reflection, from this cloud
            (infer_full_scale) or from a stream of clouds (StreamScale).

    Returns:
        The PointCloud, and the indices (N,) of its points in the message.

    Raises:
        InputError: The cloud is malformed.
    """
    try:
        points = to_array(msg)
        indices = None
        if "in_view" in (points.dtype.names or ()):
            indices = np.flatnonzero(_read_scalar_field(points, "in_view"))
            points = points.take(indices)
        coordinates = read_xyz(points)
        raw_intensity = None if intensity_max is None else _read_raw_intensity(points)
    except CloudError as error:
        raise InputError(str(error)) from None
    intensity = None if raw_intensity is None else to_unit(raw_intensity[0], intensity_max or scale(*raw_intensity))
    is_usable = are_usable_returns(coordinates)
    if not is_usable.all():
        usable_indices = np.flatnonzero(is_usable)
        indices = usable_indices if indices is None else indices.take(usable_indices)
        coordinates = coordinates.take(usable_indices, axis=0)
        intensity = None if intensity is None else intensity.take(usable_indices)
    cloud = PointCloud(coordinates, intensity, to_ns(msg.header.stamp), msg.header.frame_id)
    return cloud, np.arange(len(points)) if indices is None else indices


def _read_raw_intensity(points: np.ndarray) -> tuple[np.ndarray, np.dtype] | None:
    name = next((n for n in INTENSITY_FIELDS if n in (points.dtype.names or ())), None)
    return None if name is None else (read_columns(points, (name,))[:, 0], points.dtype[name])


def read_raw_intensity(msg: Any) -> tuple[np.ndarray, np.dtype] | None:
    """Read the unscaled intensities of all points of a PointCloud2.

    Returns:
        The values (N,) float32 and their dtype in the message; None without an intensity field.

    Raises:
        InputError: The cloud is malformed.
    """
    try:
        return _read_raw_intensity(to_array(msg))
    except CloudError as error:
        raise InputError(str(error)) from None


def diagnose_recorded_intensity(source: Any, clouds: Sequence[PointCloud]) -> str | None:
    """Return a message with the remedy if the intensity scale in some clouds of a recording is implausible, or None."""
    intensities = [cloud.intensity for cloud in clouds if cloud.intensity is not None]
    problem = find_scale_problem(np.concatenate(intensities)) if intensities else None
    return problem and (f"{source}: {problem}; for a bag or cloud files, set it with convert --robot")


def scatter_values(values: np.ndarray | int, indices: np.ndarray, msg: Any, dtype: str) -> np.ndarray:
    """Return a column for all points of a cloud with `values` (N,) at `indices` (N,), otherwise 0."""
    column = np.zeros(msg.height * msg.width, dtype)
    column[indices] = values
    return column


def read_column(msg: Any, name: str, indices: np.ndarray) -> np.ndarray | None:
    """Read the values (N,) of a field at indices (N,); None if the cloud has no such field.

    Raises:
        InputError: The field has several numbers per point.
    """
    points = to_array(msg)
    return _read_scalar_field(points, name).take(indices) if name in (points.dtype.names or ()) else None


def make_xyz_cloud(msg: Any, xyz: np.ndarray, indices: np.ndarray, make: Any) -> Any:
    """Make a PointCloud2 with float32 fields x, y, z, and intensity if `msg` has it.

    Args:
        msg: Cloud from which the header and the intensity are copied.
        xyz: (M, 3) coordinates of the new points.
        indices: (M,) indices of these points in `msg`.
    """
    names = to_array(msg).dtype.names or ()
    fields = {axis: xyz[:, i] for i, axis in enumerate("xyz")}
    for name in [n for n in INTENSITY_FIELDS if n in names][:1]:
        fields["intensity"] = _read_scalar_field(to_array(msg), name).take(indices)
    points = np.empty(len(xyz), [(name, "<f4") for name in fields])
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes inf
        for name, values in fields.items():
            points[name] = values
    return from_array(points, msg.header, make)


def read_cluster_ids(msg: Any, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Read the column `cluster_id` of a cloud; any clustering node may have written it.

    Returns:
        Labels (N,) int32 of the points at indices (N,): 0 for noise, 1..K for clusters; and the ids
        (K,) int64 of these clusters in the message (see groups.renumber_ids). None if the message
        has no such column.

    Raises:
        InputError: The column does not contain ids.
    """
    ids = read_column(msg, "cluster_id", indices)
    return None if ids is None else renumber_ids(ids)


def _read_scalar_field(points: np.ndarray, name: str) -> np.ndarray:
    """Return the values (N,) of a field.

    Raises:
        InputError: The field has several numbers per point.
    """
    if points.dtype[name].shape:
        raise InputError(f"field '{name}' has count > 1; it must have one number per point")
    return points[name]


def read_calibration(info: Any, transform: Any) -> Calibration:
    """Read the calibration of a camera from its CameraInfo and its extrinsics.

    Args:
        info: sensor_msgs/CameraInfo.
        transform: geometry_msgs/TransformStamped between the LiDAR and camera frames, in either
            direction.

    Raises:
        InputError: P is empty, or the frame names of the two messages do not match.
    """
    t, q = transform.transform.translation, transform.transform.rotation
    lidar_to_camera = poses.make_pose(
        *poses.check_pose((t.x, t.y, t.z), (q.x, q.y, q.z, q.w), "the LiDAR-to-camera transform")
    )
    parent, child = transform.header.frame_id, transform.child_frame_id
    if info.header.frame_id != parent:  # the message has the camera's pose in the LiDAR frame, so invert it
        if info.header.frame_id != child:
            raise InputError(
                f"CameraInfo is in frame '{info.header.frame_id}', but the transform connects '{parent}' and "
                f"'{child}'; publish the transform between the LiDAR and this camera"
            )
        lidar_to_camera = poses.invert_pose(lidar_to_camera)
    return make_calibration(info, lidar_to_camera)


def make_calibration(info: Any, lidar_to_camera: np.ndarray) -> Calibration:
    """Make the calibration from CameraInfo and the pose (4, 4) of the LiDAR in the camera frame.

    Raises:
        InputError: P is empty.
    """
    intrinsics = np.asarray(info.p, float).reshape(3, 4)
    if intrinsics[0, 0] <= 0 or info.width == 0 or info.height == 0:
        raise InputError(
            "CameraInfo has no projection matrix P or no image size; calibrate the camera, or set view.enabled to false"
        )
    return Calibration(intrinsics, lidar_to_camera, int(info.width), int(info.height))


def make_camera_info(calibration: Calibration, header: Any, make: Any) -> Any:
    """Make the CameraInfo of a rectified image, without distortion."""
    p = calibration.intrinsics
    return make(
        "sensor_msgs/msg/CameraInfo",
        header=header,
        height=calibration.height,
        width=calibration.width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=p[:, :3].ravel().copy(),
        r=np.eye(3).ravel(),
        p=p.ravel().copy(),
    )


def make_extrinsics(calibration: Calibration, header: Any, make: Any) -> Any:
    """Make a TransformStamped with the pose of the camera in the LiDAR frame named in `header`."""
    rotation, translation = calibration.pose
    x, y, z = map(float, translation)
    qx, qy, qz, qw = map(float, rotation)
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header,
        child_frame_id=CAMERA_FRAME,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )


def make_truth_markers(truth: GroundTruth, header: Any, make: Any, previous: Any = ()) -> Any:
    """Make the MarkerArray of labels; for `previous` see to_marker_array.

    Marker ids are the track ids if these are unique. Unknown classes keep their names (see
    to_truth).
    """
    labels = [str(extra.get("class_name", label)) for label, extra in zip(truth.labels, truth.extras)]
    track_ids: list[Any] = [extra.get("track_id") for extra in truth.extras]
    has_unique_ids = all(t is not None and 0 <= t < MAX_ID for t in track_ids) and len(
        set(zip(labels, track_ids))
    ) == len(track_ids)
    return to_marker_array(
        truth.boxes,
        labels,
        header=header,
        make=make,
        ids=track_ids if has_unique_ids else None,
        extras=truth.extras,
        notes=truth.notes,
        previous=previous,
    )


def to_class_ids(names: Iterable[str]) -> list[int]:
    """Return the indices into CLASSES of class names or aliases; Misc if unknown."""
    return [ID_BY_ALIAS.get(name.casefold(), CLASSES.index("Misc")) for name in names]


def find_unknown_classes(names: Iterable[str]) -> list[str]:
    """Return the sorted names that are neither class names nor aliases."""
    return sorted({name for name in names if name.casefold() not in ID_BY_ALIAS})


def to_truth(objects: MarkedObjects) -> GroundTruth:
    """Convert markers to labels; unknown classes become Misc, with extras["class_name"]."""
    extras = [
        {"class_name": label, **extra} if label not in CLASSES else extra
        for label, extra in zip(objects.labels, objects.extras)
    ]
    return GroundTruth.of(objects.boxes, find_class_ids(objects.labels), extras, objects.notes)


def to_detections(objects: MarkedObjects) -> Detections:
    """Convert markers to detections; objects of an unknown class become Misc."""
    return Detections.of(objects.boxes, np.array(to_class_ids(objects.labels), np.int32), objects.scores)


def make_detection_rows(
    detections: Detections, previous: Any = (), clusters: np.ndarray | None = None
) -> list[MarkerRow]:
    """Make the markers of K detections.

    The text of each marker is JSON with the id, the probabilities by source, and `cluster_id`,
    which does not fit into the 32 bits of a marker id.

    Args:
        previous: Keys of the previous array, see to_marker_array.
        clusters: (K,) ids in the column `cluster_id` of the cloud if the detections are clusters.
    """
    labels = [CLASSES[i] for i in detections.class_ids]
    texts: list[dict[str, Any]] = [{"id": i} for i in range(len(detections))]
    if detections.sources:
        for i, text in enumerate(texts):
            text["sources"] = {
                name: round(float(scores[i]), 3)
                for name, scores in detections.sources.items()
                if np.isfinite(scores[i])
            }
    for text, cluster in zip(texts, () if clusters is None else clusters):
        text["cluster_id"] = int(cluster)
    return make_marker_rows(detections.boxes, labels, detections.scores, extras=texts, previous=previous)


def make_pose_covariances(class_ids: np.ndarray) -> np.ndarray:
    """Make the pose covariances of K detections, from the measured errors of their classes.

    Args:
        class_ids: (K,) indices into CLASSES.

    Returns:
        (K, 6, 6) float64 as in geometry_msgs/PoseWithCovariance: x, y, z, roll, pitch, yaw in metres
        and radians. The entries of roll and pitch are 0, and those of classes without a measurement
        are all 0.
    """
    return DETECTION_COVARIANCES[class_ids]


def make_odometry(pose: np.ndarray, header: Any, moving_frame: str, make: Any) -> Any:
    """Make a nav_msgs/Odometry with the pose (4, 4) of `moving_frame` in the frame of `header`."""
    x, y, z = map(float, pose[:3, 3])
    qx, qy, qz, qw = map(float, Rotation.from_matrix(pose[:3, :3]).as_quat())
    position = make("geometry_msgs/msg/Point", x=x, y=y, z=z)
    orientation = make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
    message = make("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    return make(
        "nav_msgs/msg/Odometry",
        header=header,
        child_frame_id=moving_frame,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=message),
    )
