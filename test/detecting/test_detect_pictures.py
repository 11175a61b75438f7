"""Pictures and videos of `detect`."""

from __future__ import annotations

import importlib.util

import pytest
from bag_samples import cloud_frame
from detect_samples import detect, detect_with_error, make_run
from PIL import Image
from samples import STAMP, make_scene

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.open import open_recording
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


def test_pictures_and_video_show_every_frame(drives, tmp_path, monkeypatch, stand_in_calls):
    out, video = tmp_path / "out", tmp_path / "films/drive.gif"
    assert detect(monkeypatch, drives, "--out", out, "--png", "--video", video, "--track", "--ego", "none") == 0
    names = [frame.name for frame in open_recording(drives)]
    images = {name: Image.open(out / f"png/{name}.png") for name in names}
    assert {image.size for image in images.values()} == {(1280, 720)}
    assert Image.open(video).n_frames == len(names)
    assert not (out / "detections.json").exists()  # not requested
    first_times = {name: (out / f"png/{name}.png").stat().st_mtime_ns for name in names}
    (out / f"png/{names[1]}.png").unlink()
    assert detect(monkeypatch, drives, "--out", out, "--png", "--track", "--ego", "none") == 0
    second_times = {name: (out / f"png/{name}.png").stat().st_mtime_ns for name in names}
    assert [name for name in names if second_times[name] != first_times[name]] == [names[1]]
    assert len(stand_in_calls) == len(names)


def test_unsupported_video_is_rejected_before_any_work(drives, tmp_path, monkeypatch, capsys, stand_in_calls):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "av" else find_spec(name, *more)
    )
    for name, message in ("a.mp4", "lidar_perception[video]"), ("a.avi", "is not a video"):
        line = detect_with_error(monkeypatch, capsys, drives, "--out", tmp_path / "out", "--video", tmp_path / name)
        assert message in line
    assert stand_in_calls == [] and not (tmp_path / "out").exists()
