"""The ground of a frame, by any of the three methods; and how high the sensor is mounted."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike

from lidar_perception.data.frame import Recording
from lidar_perception.ground.cloth import segment_by_cloth
from lidar_perception.ground.params import GroundParams, SensorPoseParams, ThresholdParams
from lidar_perception.ground.patchwork import segment_by_patchwork
from lidar_perception.ground.threshold import ransac_plane, segment_by_threshold
from lidar_perception.intensity import guessed_scale, to_unit
from lidar_perception.robot.crop import cropped
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placing import levelling, tilted
from lidar_perception.types import SENSOR_HEIGHT, InputError, LidarFrame, as_frame, usable_returns

METHODS = {  # xyz (M, 3) level, intensity (M,) or None, params -> (M,) bool
    "threshold": lambda xyz, intensity, p: segment_by_threshold(xyz, p.threshold,
                                                                p.sensor_pose.height),
    "patchwork": lambda xyz, intensity, p: segment_by_patchwork(xyz, intensity,
                                                                p.sensor_pose.height, p.patchwork),
    "cloth": lambda xyz, intensity, p: segment_by_cloth(xyz, p.cloth),
}

# Where the height of the sensor is measured: beyond the vehicle, near enough for a plane.
NEAREST, FARTHEST = 2.5, 25.0    # m
PLANE = ThresholdParams(max_slope=15.0)
STEEP = ThresholdParams(max_slope=30.0)  # where a sensor leans
MIN_SHARE = 0.15               # of these points on the plane
FIRST = 3                      # clouds
HEIGHT_TOLERANCE = 0.25          # m between the parameter and the measured height
MAX_LEAN = 5.0                   # degrees; as much as roads slope


def segment_ground(cloud: LidarFrame | ArrayLike,
                   params: GroundParams = GroundParams()) -> np.ndarray:
    """Return (N,) bool, True = ground, for the N points of a LidarFrame or of an array (N, 3) or
    (N, 4) as LidarFrame.of takes it. Points that are not finite are not ground; an empty cloud has
    an empty mask. The points are levelled by sensor_pose for this; the cloud stays as it is.
    InputError for other arrays."""
    frame = as_frame(cloud)
    usable = usable_returns(frame.xyz)
    if usable.all():
        return _segment(frame.xyz, frame.intensity, params)
    ground = np.zeros(len(frame), bool)
    intensity = None if frame.intensity is None else frame.intensity[usable]
    ground[usable] = _segment(frame.xyz[usable], intensity, params)
    return ground


def _segment(xyz: np.ndarray, intensity: np.ndarray | None, params: GroundParams) -> np.ndarray:
    if intensity is not None and (full := guessed_scale(intensity)) != 1.0:
        intensity = to_unit(intensity, full)
    return METHODS[params.method](level(xyz, params.sensor_pose), intensity, params)


def level(xyz: np.ndarray, pose: SensorPoseParams) -> np.ndarray:
    """Points (N, 3) float32 as a level sensor at the same place would see them: turned by roll
    about x, then by pitch about y, as in a URDF's rpy. xyz itself where both are 0."""
    if pose.roll == pose.pitch == 0.0:
        return xyz
    return xyz @ tilted(pose.roll, pose.pitch)[:3, :3].T.astype(np.float32)


def cropped_as_mounted(frame: LidarFrame, crop: CropParams,
                       pose: SensorPoseParams) -> tuple[np.ndarray, LidarFrame]:
    """As robot.crop.cropped, the sectors as a level sensor at the same place would see them."""
    return cropped(frame, crop, level=levelling(tilted(pose.roll, pose.pitch)))


def measured_height(xyz: np.ndarray, pose: SensorPoseParams = SensorPoseParams()) -> float | None:
    """Metres of the sensor above the plane that holds most of the points (N, 3) around it;
    negative if that is overhead, as for a sensor mounted upside down. None where there is no
    such plane."""
    plane = _floor(level(xyz, pose))
    return None if plane is None else -float(plane[2])


def _floor(xyz: np.ndarray, params: ThresholdParams = PLANE) -> np.ndarray | None:
    """The plane z = a x + b y + c, (3,), that holds most of the points (N, 3) around; None where
    there is none."""
    square = np.einsum("ij,ij->i", xyz[:, :2], xyz[:, :2])
    near = xyz.compress((square >= NEAREST**2) & (square <= FARTHEST**2), axis=0)
    plane = ransac_plane(near, params)
    if plane is None:
        return None
    x, y, z = near.T
    on_plane = np.abs(z - (plane[0] * x + plane[1] * y + plane[2])) <= params.inlier_distance
    return plane if on_plane.mean() >= MIN_SHARE else None


def first_clouds(recording: Recording) -> list[LidarFrame]:
    """What mounted() and mount_problem() look at; none where one of them cannot be read, which who
    needs it says."""
    try:
        return [frame.load() for frame in islice(recording, FIRST)]
    except InputError:
        return []


def _floors(clouds: Sequence[LidarFrame], params: ThresholdParams = PLANE) -> np.ndarray:
    """(K, 3): the floors of clouds, where there are such."""
    return np.array([plane for cloud in clouds if len(cloud)
                     if (plane := _floor(cloud.xyz, params)) is not None]).reshape(-1, 3)


def mounted(recording: Recording, clouds: Sequence[LidarFrame]) -> Recording:
    """A recording that does not say how high its sensor is, with the height that its first clouds
    show, the median, where they agree on another one than about KITTI's; else as it is."""
    if recording.mounted or recording.reopen is None:
        return recording
    heights = -_floors(clouds)[:, 2]
    if not len(heights) or np.ptp(heights) > HEIGHT_TOLERANCE:
        return recording
    height = round(float(np.median(heights)), 2)
    if height < 0 or abs(height - SENSOR_HEIGHT) <= HEIGHT_TOLERANCE:
        return recording
    return recording.reopen(sensor_height=height)


def mount_problem(recording: Recording, clouds: Sequence[LidarFrame]) -> str | None:
    """That the sensor of a recording leans, or is upside down, by its first clouds, with the
    remedy; None where it is level, or less than two of them show it."""
    floors = _floors(clouds, STEEP)
    if len(floors) < 2:
        return None
    height = -float(np.median(floors[:, 2]))
    lean = float(np.median(np.degrees(np.arctan(np.hypot(*floors[:, :2].T)))))
    if height >= 0 and lean <= MAX_LEAN:
        return None
    seems = (f"its sensor leans by {lean:.0f} degrees against the ground" if height >= 0 else
             f"the ground seems to be {-height:.2f} m above its sensor: it is upside down")
    return (f"{seems}, where detectors take z as up; measure it with setup, and make a level bag "
            f"with convert {recording.path} --robot robot/robot.param.yaml --out level.bag")


def height_problem(measured: float | None, pose: SensorPoseParams) -> str | None:
    """What a measured height says against sensor_pose, with the remedy; None if they agree."""
    if measured is None or abs(measured - pose.height) <= HEIGHT_TOLERANCE:
        return None
    if measured < 0:
        return (f"the ground seems to be {-measured:.2f} m above the sensor; if it is mounted "
                "upside down, set ground.sensor_pose.roll to 3.1416")
    return (f"the sensor is {measured:.2f} m above the ground but ground.sensor_pose.height is "
            f"{pose.height:g}; set it to {measured:.2f}")
