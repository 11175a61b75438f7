"""ROS messages <-> the core's types, for nodes and bags alike (either kind of message class)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike
from scipy.spatial.transform import Rotation

from lidar_perception.camera import Calibration, Camera
from lidar_perception.classes import CALLED
from lidar_perception.groups import renumbered
from lidar_perception.intensity import INTENSITY_FIELDS, full_scale, scale_problem, to_unit
from lidar_perception.robot import poses
from lidar_perception.types import (
    CLASSES,
    Detections,
    GroundTruth,
    InputError,
    LidarFrame,
    class_ids,
    usable_returns,
)
from lidar_perception.wire.topics import CAMERA_FRAME
from msg_utils.markers import MarkedObjects, to_marker_array
from msg_utils.point_cloud2 import CloudError, columns, from_array, to_array, xyz
from msg_utils.stamps import to_ns

MAX_ID = 2**31  # a marker's id is an int32
FullScale = Callable[[np.ndarray, DTypeLike], float]  # see intensity.full_scale


def to_frame(msg: Any, intensity_max: float | None = None,
             scale: FullScale = full_scale) -> tuple[LidarFrame, np.ndarray]:
    """Return the usable points of a PointCloud2 and their indices (N,) in the cloud; if the cloud
    has a column in_view, only the points where it is not 0. InputError for a broken cloud.

    intensity_max: the value of a full reflection; 0: what scale says; None: intensity is not read.
    scale: infers it; full_scale looks at this cloud alone, a StreamScale at those before it, too.
    """
    try:
        points = to_array(msg)
        indices = None
        if "in_view" in (points.dtype.names or ()):
            indices = np.flatnonzero(_single(points, "in_view"))
            points = points.take(indices)
        coordinates = xyz(points)
        intensity = None if intensity_max is None else _intensity(points, intensity_max, scale)
    except CloudError as error:
        raise InputError(str(error)) from None
    usable = usable_returns(coordinates)
    if not usable.all():
        kept = np.flatnonzero(usable)
        indices = kept if indices is None else indices.take(kept)
        coordinates = coordinates.take(kept, axis=0)
        intensity = None if intensity is None else intensity.take(kept)
    frame = LidarFrame(coordinates, intensity, to_ns(msg.header.stamp), msg.header.frame_id)
    return frame, np.arange(len(points)) if indices is None else indices


def _intensity(points: np.ndarray, full: float, scale: FullScale) -> np.ndarray | None:
    """(N,) float32, see intensity.to_unit; None without such a field."""
    if (raw := _raw_intensity(points)) is None:
        return None
    values, kind = raw
    return to_unit(values, full or scale(values, kind))


def _raw_intensity(points: np.ndarray) -> tuple[np.ndarray, np.dtype] | None:
    name = next((n for n in INTENSITY_FIELDS if n in (points.dtype.names or ())), None)
    return None if name is None else (columns(points, (name,))[:, 0], points.dtype[name])


def raw_intensity(msg: Any) -> tuple[np.ndarray, np.dtype] | None:
    """Return the intensities (N,) float32 of all points of a PointCloud2 as the driver wrote them,
    and their type in the message; None without such a field. InputError for a broken cloud."""
    try:
        return _raw_intensity(to_array(msg))
    except CloudError as error:
        raise InputError(str(error)) from None


def intensity_problem(frame: LidarFrame) -> str | None:
    """Return the scale_problem() of a frame's intensity."""
    return scale_problem(frame.intensity)


def recorded_intensity_problem(source: Any, clouds: Sequence[LidarFrame]) -> str | None:
    """Return the scale_problem() of some clouds of a recording, the source, all together."""
    found = [cloud.intensity for cloud in clouds if cloud.intensity is not None]
    problem = scale_problem(np.concatenate(found)) if found else None
    return problem and f"{source}: {problem}; a bag or cloud files need convert --robot then"


def spread(values: np.ndarray | int, indices: np.ndarray, msg: Any, dtype: str) -> np.ndarray:
    """Values (N,) at indices (N,) as a column of the whole cloud msg; 0 elsewhere."""
    column = np.zeros(msg.height * msg.width, dtype)
    column[indices] = values
    return column


def column(msg: Any, name: str, indices: np.ndarray) -> np.ndarray | None:
    """(N,) values of a field at indices (N,); None where the cloud has no such field. InputError if
    it holds more than one number a point."""
    points = to_array(msg)
    return _single(points, name).take(indices) if name in (points.dtype.names or ()) else None


def thin_cloud(msg: Any, xyz: np.ndarray, indices: np.ndarray, make: Any) -> Any:
    """PointCloud2 with the header of msg and x y z (M, 3), and intensity where msg has one, as it
    is there at indices (M,); all of them float32."""
    names = to_array(msg).dtype.names or ()
    fields = {axis: xyz[:, i] for i, axis in enumerate("xyz")}
    for name in [n for n in INTENSITY_FIELDS if n in names][:1]:
        fields["intensity"] = _single(to_array(msg), name).take(indices)
    points = np.empty(len(xyz), [(name, "<f4") for name in fields])
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes inf
        for name, values in fields.items():
            points[name] = values
    return from_array(points, msg.header, make)


def cluster_column(msg: Any, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """labels (N,) int32 of the points at indices (N,), 0 none and 1..K, from the column cluster_id
    of whatever clustering, and numbers (K,) int64, the ids there (see groups.renumbered); None
    where the cloud has no such column. InputError if it holds no ids."""
    ids = column(msg, "cluster_id", indices)
    return None if ids is None else renumbered(ids)


def _single(points: np.ndarray, name: str) -> np.ndarray:
    """(N,) values of a field with one number a point; InputError if it has more."""
    if points.dtype[name].shape:
        raise InputError(f"field '{name}' has count > 1; a single number is needed")
    return points[name]


def calibration_of(info: Any, transform: Any) -> Calibration:
    """From CameraInfo and the TransformStamped between the LiDAR frame and the camera's, in either
    direction. InputError when P is empty or the frames do not fit."""
    t, q = transform.transform.translation, transform.transform.rotation
    lidar_to_camera = poses.pose_of(*poses.checked(
        (t.x, t.y, t.z), (q.x, q.y, q.z, q.w), "the LiDAR-to-camera transform"))
    parent, child = transform.header.frame_id, transform.child_frame_id
    if info.header.frame_id != parent:  # it is the camera's pose in the LiDAR frame: turn it round
        if info.header.frame_id != child:
            raise InputError(f"CameraInfo is in frame '{info.header.frame_id}' but the transform "
                             f"links '{parent}' and '{child}'")
        lidar_to_camera = poses.inverse(lidar_to_camera)
    return calibrated(info, lidar_to_camera)


def calibrated(info: Any, lidar_to_camera: np.ndarray) -> Calibration:
    """From CameraInfo and the pose (4, 4) of the LiDAR in the camera's frame. InputError when P is
    empty."""
    intrinsics = np.asarray(info.p, float).reshape(3, 4)
    if intrinsics[0, 0] <= 0 or info.width == 0 or info.height == 0:
        raise InputError("CameraInfo has no projection matrix P or no image size; calibrate the "
                         "camera or set view.enabled to false")
    return Calibration(intrinsics, lidar_to_camera, int(info.width), int(info.height))


def camera_of(info: Any, transform: Any) -> Camera:
    """The camera of calibration_of."""
    return calibration_of(info, transform).camera()


def camera_info(calibration: Calibration, header: Any, make: Any) -> Any:
    """CameraInfo of the calibration's rectified image, without distortion."""
    p = calibration.intrinsics
    return make("sensor_msgs/msg/CameraInfo", header=header, height=calibration.height,
                width=calibration.width, distortion_model="plumb_bob", d=np.zeros(5),
                k=p[:, :3].ravel().copy(), r=np.eye(3).ravel(), p=p.ravel().copy())


def extrinsics(calibration: Calibration, header: Any, make: Any) -> Any:
    """TransformStamped: the camera frame in the LiDAR frame of header."""
    rotation, translation = calibration.pose
    x, y, z = map(float, translation)
    qx, qy, qz, qw = map(float, rotation)
    return make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=CAMERA_FRAME,
                transform=make("geometry_msgs/msg/Transform",
                               translation=make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                               rotation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz,
                                             w=qw)))


def truth_markers(truth: GroundTruth, header: Any, make: Any, previous: Any = ()) -> Any:
    """MarkerArray of the labels. Objects keep the marker id of their track, and the name of a class
    that is not known, see to_truth."""
    labels = [str(extra.get("class_name", label))
              for label, extra in zip(truth.labels, truth.extras)]
    tracks: list[Any] = [extra.get("track_id") for extra in truth.extras]
    unique = (all(t is not None and 0 <= t < MAX_ID for t in tracks)
              and len(set(zip(labels, tracks))) == len(tracks))
    return to_marker_array(truth.boxes, labels, header=header, make=make,
                           ids=tracks if unique else None,
                           extras=truth.extras, notes=truth.notes, previous=previous)


def any_class_ids(names: Iterable[str]) -> list[int]:
    """Into CLASSES, of what any stack calls them; an unknown name is Misc."""
    return [CALLED.get(name.casefold(), CLASSES.index("Misc")) for name in names]


def unknown_names(names: Iterable[str]) -> list[str]:
    """Those that any_class_ids does not know, each once."""
    return sorted({name for name in names if name.casefold() not in CALLED})


def to_truth(objects: MarkedObjects) -> GroundTruth:
    """Labels from markers; objects of unknown class are Misc, with their own in extras'
    class_name."""
    extras = [{"class_name": label, **extra} if label not in CLASSES else extra
              for label, extra in zip(objects.labels, objects.extras)]
    return GroundTruth.of(objects.boxes, class_ids(objects.labels), extras, objects.notes)


def to_detections(objects: MarkedObjects) -> Detections:
    """Detections from markers; objects of unknown class are Misc."""
    return Detections.of(objects.boxes, np.array(any_class_ids(objects.labels), np.int32),
                         objects.scores)


def detection_markers(detections: Detections, header: Any, make: Any, previous: Any = (),
                      lifetime_ns: int = 0, clusters: np.ndarray | None = None) -> Any:
    """MarkerArray of K detections, with their ids in the text too, what each of their sources says
    where it says something, and the cluster_id (K,) of each where it is one cluster of the cloud: a
    marker's own id has 32 bits, which not every cluster_id fits. previous and lifetime_ns as in
    to_marker_array."""
    labels = [CLASSES[i] for i in detections.class_ids]
    texts: list[dict[str, Any]] = [{"id": i} for i in range(len(detections))]
    if detections.sources:
        for i, text in enumerate(texts):
            text["sources"] = {name: round(float(said[i]), 3) for name, said
                               in detections.sources.items() if np.isfinite(said[i])}
    for text, cluster in zip(texts, () if clusters is None else clusters):
        text["cluster_id"] = int(cluster)
    return to_marker_array(detections.boxes, labels, detections.scores, header=header, make=make,
                           extras=texts, previous=previous, lifetime_ns=lifetime_ns)


def odometry(pose: np.ndarray, header: Any, moving_frame: str, make: Any) -> Any:
    """nav_msgs/Odometry: the pose (4, 4) of moving_frame in the frame of header."""
    x, y, z = map(float, pose[:3, 3])
    qx, qy, qz, qw = map(float, Rotation.from_matrix(pose[:3, :3]).as_quat())
    place = make("geometry_msgs/msg/Pose", position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
                 orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw))
    return make("nav_msgs/msg/Odometry", header=header, child_frame_id=moving_frame,
                pose=make("geometry_msgs/msg/PoseWithCovariance", pose=place))


def pose_of(pose: Any) -> np.ndarray:
    """(4, 4) float64 of a geometry_msgs/Pose. InputError if it is not finite, or its quaternion is
    no rotation."""
    p, q = pose.position, pose.orientation
    return poses.pose_of(*poses.checked((p.x, p.y, p.z), (q.x, q.y, q.z, q.w), "a pose"))
