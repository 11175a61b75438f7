"""Simulated drives as labelled frames: of a car with a camera like KITTI's, of robots without."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from lidar_perception.data.frame import Frame
from lidar_perception.simulation.camera import FORWARD_CAMERA, labels_around, labels_in_view
from lidar_perception.simulation.drive import longest_drive, scan_at
from lidar_perception.simulation.scene import ANY, Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor

GAP_NS = 10 * 10**9  # between the drives through two scenes, as between KITTI's recordings


def simulated_scans(seed: int, frames: int, sensor: Sensor = HDL64E,
                    streets_of: int | None = None, scenes: Scenes = ANY) -> Iterator[Frame]:
    """Frames with the forward camera and, as in KITTI, labels of the objects whose centre it sees;
    where not all scenes have a camera, without one and with labels all around: streets_of
    (default: as many as fit) of each of the scenes seed, seed + 1, ..."""
    camera, labels = ((FORWARD_CAMERA, labels_in_view) if scenes.camera else
                      (None, labels_around))
    each = streets_of or longest_drive(sensor)
    drive_ns = GAP_NS + round(each * 10**9 / sensor.rate)
    for number in range(frames):
        scene, moment = divmod(number, each)
        scan = scan_at(seed + scene, moment, sensor, scenes)
        frame = replace(scan.frame, stamp_ns=scan.frame.stamp_ns + scene * drive_ns)
        yield Frame.of(f"{scene:04}/{moment:06}", frame, labels(scan.truth),
                       camera, pose=scan.pose.copy, sequence=f"{scene:04}", index=moment,
                       sensor_height=sensor.height)
