"""Pictures of `detect`."""

from __future__ import annotations

import pytest
from bag_samples import cloud_frame
from detect_samples import make_run
from samples import STAMP, make_scene

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.detecting.pictures import FrameDrawer
from lidar_perception.detecting.results import FrameResult
from lidar_perception.types import Detections


@pytest.mark.parametrize(
    "stamp, timed, expected",
    [(STAMP, True, "2023-11-14 22:13:20.123 UTC"), (STAMP, False, "1.5 s"), (7 * 10**9, True, "1.5 s")],
)
def test_pictures_show_the_time(stamp, timed, expected, tmp_path):
    frames = [Frame.of(str(i), cloud_frame(make_scene(i), stamp + i * 10**9 - 15 * 10**8)) for i in range(2)]
    run = make_run(Recording(tmp_path / "drive", "", frames, has_times=timed), tmp_path / "out")
    drawer = FrameDrawer(run)
    drawer.get_settings(FrameResult(frames[0], Detections.none(), "velodyne", 1.0))
    assert drawer.format_time(stamp) == expected
