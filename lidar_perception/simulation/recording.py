"""Simulated drives as labelled frames: a car with KITTI's camera, or robots without a camera."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lidar_perception.data.frame import BOXES, CAMERA, POSES, ComputedFrames, Frame, Recording
from lidar_perception.simulation.camera import FORWARD_CAMERA, select_labels, select_labels_in_view
from lidar_perception.simulation.drive import count_drive_scans, simulate_scan
from lidar_perception.simulation.scene import ALL_STREETS, Scenes
from lidar_perception.simulation.sensor import HDL64E, Sensor

DRIVE_GAP_NS = 10 * 10**9  # time between the drives through two scenes


class SimulatedFrames(ComputedFrames):
    """Frames of simulated drives, computed when they are read.

    If all scenes have a camera, only objects with their centre in the image are labelled, as in
    KITTI. Otherwise objects in all directions are labelled.
    """

    def __init__(
        self,
        seed: int,
        frames: int,
        sensor: Sensor = HDL64E,
        frames_per_drive: int | None = None,
        scenes: Scenes = ALL_STREETS,
    ) -> None:
        """Create the sequence without computing any frame.

        Args:
            seed: Seed of the first scene; the next scene has seed + 1.
            frames: Number of frames.
            frames_per_drive: Number of frames of each scene; None uses the full drive.
            scenes: Types of the scenes.
        """
        self._seed, self._frames, self._sensor, self._scenes = seed, frames, sensor, scenes
        self._per_drive = frames_per_drive or count_drive_scans(sensor)
        self._has_camera = scenes.camera

    def __len__(self) -> int:
        return self._frames

    def compute_frame(self, number: int) -> Frame:
        camera, labels = (FORWARD_CAMERA, select_labels_in_view) if self._has_camera else (None, select_labels)
        scene, index = divmod(number, self._per_drive)
        drive_ns = DRIVE_GAP_NS + round(self._per_drive * 10**9 / self._sensor.rate)
        scan = simulate_scan(self._seed + scene, index, self._sensor, self._scenes)
        frame = replace(scan.frame, stamp_ns=scan.frame.stamp_ns + scene * drive_ns)
        return Frame.of(
            f"{scene:04}/{index:06}",
            frame,
            labels(scan.truth),
            camera,
            pose=scan.pose.copy,
            sequence=f"{scene:04}",
            index=index,
            sensor_height=self._sensor.height,
        )


def simulate_frames(
    seed: int, frames: int, sensor: Sensor = HDL64E, frames_per_drive: int | None = None, scenes: Scenes = ALL_STREETS
) -> Iterator[Frame]:
    """Yield simulated frames, see SimulatedFrames."""
    yield from SimulatedFrames(seed, frames, sensor, frames_per_drive, scenes)


def simulate_recording(seed: int, frames: int, sensor: Sensor = HDL64E, scenes: Scenes = ALL_STREETS) -> Recording:
    """Return a recording of drives that are simulated in memory, without files."""
    content = {BOXES, POSES} | ({CAMERA} if scenes.camera else set())
    return Recording(
        Path("simulation"),
        f"simulated {scenes.scene}",
        SimulatedFrames(seed, frames, sensor, None, scenes),
        frozenset(content),
        has_times=True,
    )
