"""Laws of the drives of a recording: where one ends, and what is refused at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lidar_perception.adapting.drives import FEWEST, TURNED, checked, pieces_of, turned_problem
from lidar_perception.data.frame import Frame
from lidar_perception.types import InputError, LidarFrame

BAG = Path("drive.bag")


def test_a_gap_of_the_stamps_ends_a_drive():
    def frames(*stamps: float) -> list[Frame]:
        return [Frame(str(s), int(s * 1e9), lambda: None) for s in stamps]

    first, second = np.arange(12) / 10, np.arange(15) / 10
    for later in (30.0, -0.5):  # a pause, and a clock that was put back
        pieces = pieces_of(frames(*first, *(second + later)), 100)
        assert [len(p.numbers) for p in pieces] == [12, 15]
        assert [n for p in pieces for n in p.numbers] == list(range(27))
        assert len({p.name for p in pieces}) == 2
    assert [len(p.numbers) for p in pieces_of(frames(*np.arange(200) / 10), 25)] == [25]
    assert len(pieces_of(frames(*np.zeros(20)), 100)) == 1  # a data set without stamps
    with pytest.raises(InputError, match=f"{FEWEST} frames"):
        pieces_of(frames(*range(0, 100, 5)), 100)


@pytest.mark.parametrize("runs", [(3, *[20] * 5), (2, 2, *[25] * 10, 4), (75,), (5, 70, 9, 64)])
def test_where_not_all_is_looked_at_pieces_are_long_enough_and_together_as_many(runs):
    starts = np.cumsum([0, *runs[:-1]])
    frames = [Frame("", int((30 * k + i / 10) * 1e9), lambda: None)
              for k, run in enumerate(runs) for i in range(run)]
    pieces = pieces_of(frames, 60)
    numbers = [n for piece in pieces for n in piece.numbers]
    assert len(set(numbers)) == len(numbers) and 40 <= len(numbers) <= 60
    for piece in pieces:
        assert len(piece.numbers) >= FEWEST and len(piece.held)  # followed, and judged
        assert len(np.unique(np.searchsorted(starts, piece.numbers, "right"))) == 1  # of one drive


def clouds(scale: tuple[float, float, float], count: int = 500) -> list[Frame]:
    """Frames of points all around within 20 m, their coordinates times scale."""
    xyz = np.random.default_rng(0).uniform(-20, 20, (count, 3)) * scale
    scan = LidarFrame(xyz.astype(np.float32), np.full(count, 0.3, np.float32))
    return [Frame.of(str(i), scan) for i in range(12)]


@pytest.mark.parametrize("frames, named", [
    (clouds((1000, 1000, 1000)), "millimetres"), (clouds((1, 1, 0)), "2D scanner"),
    (clouds((1, 1, 1), count=0), "no points")])
def test_clouds_that_no_detector_can_read_are_refused(frames, named):
    with pytest.raises(InputError, match=f"^{BAG}.*{named}") as error:
        checked(frames, BAG)
    assert "\n" not in str(error.value)


def test_clouds_without_intensity_or_its_scale_are_taken_and_it_is_said():
    frames = clouds((1, 1, 0.1))
    assert checked(frames, BAG) == []
    dark = [Frame.of(f.name, LidarFrame(f.load().xyz, None)) for f in frames]
    assert "no intensity" in checked(dark, BAG)[0]
    odd = [Frame.of(f.name, LidarFrame(f.load().xyz, f.load().intensity * 10)) for f in frames]
    assert "input.intensity_max" in checked(odd, BAG)[0]
    one_empty = [Frame.of("0", LidarFrame(np.zeros((0, 3), np.float32), None)), *frames[1:]]
    assert checked(one_empty, BAG) == []


@pytest.mark.parametrize("angle", [0, 15, -15, 90, -130, 180])
@pytest.mark.parametrize("course", [0.0, 2.0])
def test_a_sensor_that_looks_aside_is_named_whatever_the_course_and_the_curves(angle, course):
    """The drive is a curve, first slow, then fast; the sensor is turned against it."""
    turn = np.cumsum(np.full(40, 0.02)) + course
    way = np.cumsum(np.linspace(0, 1, 40)[:, None] * np.column_stack(
        [np.cos(turn), np.sin(turn)]), axis=0)
    poses = np.tile(np.eye(4), (40, 1, 1))
    poses[:, :2, 3] = way
    poses[:, :3, :3] = Rotation.from_euler(
        "z", (turn - np.radians(angle))[:, None]).as_matrix()
    said = turned_problem([poses, poses[5:20]], BAG)
    if abs(angle) < TURNED:
        assert said is None
    else:
        assert abs((float(said.split("towards ")[1].split()[0]) - angle + 180) % 360 - 180) < 2
    to_and_fro = np.concatenate([poses, poses[::-1]])
    assert turned_problem([to_and_fro], BAG) is None
