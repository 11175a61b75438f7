"""What cannot be told is said, with the remedy; what cannot be used is refused."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tilted_samples import clouds_of

from lidar_perception.data.raw_clouds import _to_message
from lidar_perception.robot.crop import select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.sensor_setup.coverage import stands_still
from lidar_perception.sensor_setup.doubts import doubts
from lidar_perception.sensor_setup.files import node_params, params_yaml
from lidar_perception.sensor_setup.findings import findings
from lidar_perception.sensor_setup.measure import measured, sensor_of
from lidar_perception.sensor_setup.mount import mount_of, on_the_ground
from lidar_perception.sensor_setup.scans import Scan, intensity_of, scan_of
from lidar_perception.sensor_setup.timing import timing_of
from lidar_perception.sensor_setup.told import NOTHING
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import sensor_named
from lidar_perception.simulation.to_bag import simulated_scans
from lidar_perception.types import InputError
from lidar_perception.wire.codec import bag_message
from msg_utils.point_cloud2 import from_array, to_array
from msg_utils.stamps import header_message


@cache
def messages():
    return tuple(clouds_of("vlp-16", 6))


def changed(msg, change, frame_id="lidar"):
    """The cloud with its structured array changed in place by change(points)."""
    points = to_array(msg).copy()
    points = change(points) if change else points
    return from_array(points, header_message(0, frame_id, bag_message), bag_message)


def turned(matrix):
    """A change that turns all points."""
    def change(points):
        xyz = np.column_stack([points[a] for a in "xyz"]) @ np.transpose(matrix)
        for axis, values in zip("xyz", xyz.T):
            points[axis] = values
        return points
    return change


def of(scans, numbers=(0, 1, 10, 11, 20, 21), stamps=None):
    return measured(scans, numbers[:len(scans)], "drive", 22, stamps)


def all_changed(change):
    return [scan_of(changed(msg, change)) for msg in messages()]


def said(m, *parts):
    return any(all(part in line for part in parts) for line in doubts(m))


def test_one_cloud_a_robot_that_stands_and_one_that_drives():
    scans = all_changed(None)
    one, still, drives = of(scans[:1]), of(scans[:1] * 5, (0, 1, 2, 3, 4)), of(scans)
    assert said(one, "one cloud only", "record") and one.coverage.still is None
    assert said(still, "stands still", "record") and still.coverage.still
    assert not said(drives, "stands still") and not said(drives, "one cloud")


def test_the_robots_body_is_found_and_left_out():
    """A curved panel behind the sensor, which every scan sees."""
    rng = np.random.default_rng(0)

    def with_body(points):
        new = np.zeros(960, points.dtype)
        new["ring"] = np.tile(np.arange(16), 60)
        up = np.radians(np.linspace(-15, 15, 16))[new["ring"]]
        bearing = np.repeat(np.radians(np.linspace(165.2, 194.8, 60)), 16)
        reach = 0.7 + rng.normal(0, 0.005, 960)
        new["x"], new["y"], new["z"] = (reach * np.cos(up) * np.cos(bearing),
                                        reach * np.cos(up) * np.sin(bearing), reach * np.sin(up))
        return np.concatenate([points[np.hypot(points["x"], points["y"]) > 1.0], new])

    m = of(all_changed(with_body))
    c = m.coverage
    assert c.fits and c.body.any() and c.others < 0.1
    assert (c.box[:2] < [-0.6, -0.1]).all() and (c.box[3:5] > [-0.7, 0.1]).all()
    assert -0.9 < c.box[0] and c.box[3] < 0 and np.abs(c.box[[2, 5]]).max() < 0.4
    behind = [(a, b) for ring, a, b in c.blocked if ring == 0]
    assert any(a <= 168 and b >= 192 for a, b in behind)
    assert len(of(all_changed(None)).coverage.box) == 0
    # In robot.param.yaml also as it is with base_frame, whether TF has that or the ground only.
    own = m.scans[0].xyz[np.hypot(*m.scans[0].xyz[:, :2].T) < 1.0]
    by_tf = m.told._replace(footprint=make_tilted_pose(0.1, -0.2, 0.9))
    for told, base in ((m.told, make_tilted_pose(m.mount.roll, m.mount.pitch, m.mount.height)),
                       (by_tf, by_tf.footprint)):
        (line,) = re.findall(r"# body: (.*)", params_yaml(replace(m, told=told)))
        assert select_points(own, CropParams(body=tuple(json.loads(line))), base).mean() < 0.02


def seen(half=np.inf, body=0.0, height=0.6, seed=0, turn=np.eye(3)):
    """Scans of a sensor of 16 beams so high between walls half beside it, with other things around
    in each, a deck of the robot as far behind as body, and the sky; turn: from its
    axes to level ones."""
    rng = np.random.default_rng(seed)
    up, aside = np.radians(np.meshgrid(np.arange(-15.0, 16, 2), np.arange(0.0, 360, 0.5)))
    way = np.stack([np.cos(up) * np.cos(aside), np.cos(up) * np.sin(aside), np.sin(up)], axis=-1)
    _, y, z = np.moveaxis(way @ turn.T, -1, 0)
    for _ in range(8):
        things = np.repeat(rng.uniform(5, 50, 72), 10)[:, None]
        reach = np.minimum.reduce([half / np.maximum(np.abs(y), 1e-3), height / np.maximum(
            -z, 1e-3), np.where(z > 0.2, np.inf, things)])
        reach[(np.abs(aside - np.pi) < 0.4) & (up < 0) & (body > 0)] = body
        met = np.isfinite(reach)
        yield scan_at(way[met] * reach[met, None] + rng.normal(0, 0.005, (met.sum(), 3)))


def trees():
    rng = np.random.default_rng(7)
    foot = rng.uniform(-30, 30, (1500, 2))
    return np.column_stack([np.repeat(foot, 5, axis=0), np.tile(np.linspace(0, 2, 5), 1500)])


def scan_at(xyz):
    r, flat = np.linalg.norm(xyz, axis=1), np.hypot(*xyz[:, :2].T)
    return Scan(xyz, np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])) % 360, np.degrees(
        np.arctan2(xyz[:, 2], flat)), r, flat, None, None, None, 0, "lidar", ("x", "y", "z"))


@pytest.mark.parametrize("half", [0.8, 1.1, 2.0])
def test_walls_along_the_way_are_no_body(half):
    """And neither cropped nor blind; what is of the robot in the open is."""
    m = of(list(seen(half)), range(8))
    c = m.coverage
    assert c.still is False and c.walls and not c.fits and not c.blocked
    assert said(m, "walls", "crop.body")
    c = of(list(seen(body=1.5)), range(8)).coverage
    assert c.fits and not c.walls and c.box[0] == pytest.approx(-1.55, abs=0.05) and c.blocked


def test_people_who_pass_by_do_not_move_a_robot_that_stands():
    around = np.random.default_rng(0).uniform(5, 50, (16, 360))
    passed = np.array([np.where(np.arange(360) // 36 == i, 4.5, around) for i in range(10)])
    assert stands_still(passed) and stands_still(np.roll(passed, 1, axis=0)[:2]) is not None
    assert stands_still(np.array([np.roll(around, 10 * i, axis=1) for i in range(10)])) is False
    scans = list(seen(body=0.5))
    poses = {i: make_tilted_pose(0, 0, 0.6) for i in range(8)}
    parked = measured(scans, range(8), "parked", 8, None, NOTHING._replace(poses=poses))
    assert parked.coverage.still and said(parked, "stands still")
    assert len(parked.coverage.box) and not parked.coverage.blocked
    # Between clouds that follow one another a slow robot hardly moves, either.
    numbers = [40 * (i // 2) + i % 2 for i in range(8)]
    slow = [scan_at(np.concatenate([scan.xyz[scan.xyz[:, 2] < -0.5], trees() - [0.04 * n, 0, 0]]))
            for n, scan in zip(numbers, seen())]
    m = measured(slow, numbers, "slow", 160, None)
    assert m.heading.went < 0.1 and m.coverage.still is False


def test_where_all_is_alike_poses_say_that_the_robot_moved():
    ground = [scan_at(scan.xyz[(scan.xyz[:, 2] < -0.5) | (np.hypot(*scan.xyz[:, :2].T) < 2)])
              for scan in seen(body=1.5)]
    for went, drives in ((0.0, False), (4.0, True)):
        poses = {i: make_tilted_pose(0, 0, 0) for i in range(8)}
        poses[7][0, 3] = went
        m = measured(ground, range(8), "field", 8, None, NOTHING._replace(poses=poses))
        assert (m.coverage.still is False) == drives == m.coverage.fits
        assert drives != said(m, "stands still") and not said(m, "cannot be told, as too few")


def test_clouds_whose_origin_is_on_the_ground_are_told_and_their_floor_is_no_body():
    scans = [scan_at(s.xyz + [0, 0, 0.6]) for s in seen()]
    assert mount_of(scans) is None and on_the_ground(scans) and not on_the_ground(list(seen()))
    m = of(scans, range(8))
    assert not m.coverage.body.any() and said(m, "base_footprint", "driver's own cloud")


@pytest.mark.parametrize("roll, pitch", [(0, 28), (180, -10)])
def test_of_a_sensor_that_leans_the_sky_is_not_blind_and_ground_begins_where_it_does(roll, pitch):
    lean = make_tilted_pose(*np.radians([roll, pitch]))[:3, :3]
    m = of(list(seen(turn=lean)), range(8))
    assert np.degrees(m.mount.pitch) == pytest.approx(pitch, abs=0.5) and not m.mount.level
    assert m.coverage.view == (0, 360) and not sensor_of(m).blocked and said(m, "level sensor")
    nearest = min(np.hypot(*(s.xyz[p.on] @ lean.T)[:, :2].T).min()
                  for s, p in zip(m.scans, m.mount.planes))
    assert node_params(m)["ground.patchwork.min_range"][0] <= nearest


def test_a_sector_that_never_returns_is_the_end_of_the_view():
    m = of(all_changed(lambda p: p[np.abs(np.arctan2(p["y"], p["x"])) < np.radians(60)]))
    start, end = m.coverage.view
    assert abs(start - 300) <= 1 and abs(end - 60) <= 1
    assert sensor_of(m).open_rays().mean() == pytest.approx(1 / 3, abs=0.02)


def test_a_frame_with_y_ahead_or_z_down_is_said():
    ahead = of(all_changed(turned([[0, -1, 0], [1, 0, 0], [0, 0, 1]])))
    assert abs(ahead.heading.degrees - 90) < 3 and said(ahead, "90 deg", "convert --robot")
    down = of(all_changed(turned(np.diag([1, -1, -1]))))
    assert abs(np.degrees(down.mount.roll)) == pytest.approx(175, abs=0.3)
    assert said(down, "upside down") and down.mount.height == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize("beams", [True, False])
def test_a_sensor_that_is_upside_down_is_described_as_it_hangs(beams):
    def part(points):  # it looks down more than up, and to the left
        if not beams:
            points["ring"] = 0
            nearer = np.random.default_rng(0).uniform(0.7, 1.0, len(points))
            points["x"], points["y"] = points["x"] * nearer, points["y"] * nearer
        up = np.arctan2(points["z"], np.hypot(points["x"], points["y"]))
        to = np.arctan2(points["y"], points["x"])
        return points[(up < np.radians(4)) & (to > np.radians(-30))]

    own, other = (of(all_changed(lambda p, axes=axes: turned(np.diag(axes))(part(p))))
                  for axes in ([1, 1, 1], [1, -1, -1]))
    level, hung = sensor_of(own), sensor_of(other)
    np.testing.assert_allclose(hung.elevations, level.elevations, atol=np.radians(0.1))
    np.testing.assert_allclose(hung.blocked, level.blocked, atol=1.01)
    assert hung.wander == pytest.approx(level.wander, rel=0.05) and bool(hung.wander) != beams
    if beams:  # closer to each other where people are than above
        up = np.array([14.0, 11, 8, 5, 3, 1, -6, -8, -10, -12, -14])
        assert replace(own, beams=own.beams._replace(elevations=up)).elevation_step == replace(
            other, beams=other.beams._replace(elevations=-up[::-1])).elevation_step == 2


DRIVES = {"at a robot's speed": (501, "campus", 0.92, 14, (0, 180, -25)),
          "at a car's": (502, "street", 11.15, 8, (0, 90)),
          "not at all": (504, "campus", 0.0, 6, (90,))}


@pytest.mark.parametrize("name", DRIVES)
def test_which_way_is_ahead_is_told_however_slowly_the_robot_drives(name):
    """Turned by an angle, it is that angle, and said; as it is, nothing is."""
    seed, scene, speed, count, angles = DRIVES[name]
    sensor = replace(sensor_named("vlp-16"), height=0.6)
    frames = list(simulated_scans(seed, count, sensor, 40, Scenes(scene=scene)))
    way = np.linalg.norm(frames[-1].pose()[:2, 3] - frames[0].pose()[:2, 3])
    assert way == pytest.approx(speed * (count - 1) / sensor.rate, abs=0.1)
    for degrees in angles:
        a = np.radians(degrees)
        turn = turned([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        m = of([scan_of(changed(_to_message(frame), turn)) for frame in frames], range(count))
        row = next(finding for finding in findings(m) if finding.what == "ahead")
        if not speed:
            assert said(m, "yaw not known: the robot moved only 0.0 m", "record")
            assert row.value == "not known"
            continue
        assert abs((m.heading.degrees - degrees + 180) % 360 - 180) < 5
        assert said(m, "drives towards", "input.ahead") == (degrees != 0)
        assert ("input.ahead" in node_params(m)) == (degrees in (90, -25))
        assert said(m, "backwards") == (degrees == 180) and row.sure == (
            "doubtful" if degrees else "fair") and not said(m, "yaw not known")


def test_a_frame_that_is_turned_against_the_sensor_has_no_beams_and_gets_a_grid():
    def levelled(points):
        points = turned([[0.906, 0, 0.423], [0, 1, 0], [-0.423, 0, 0.906]])(points)
        points["ring"] = 0
        return points

    m = of(all_changed(levelled))
    assert m.beams is None and said(m, "no beams", "grid")
    grid = sensor_of(m)
    low, high = np.percentile(np.concatenate([s.elevation for s in m.scans]), [1, 99])
    assert grid.wander > 0 and grid.rings * grid.columns < 60_000
    assert np.degrees(grid.elevations[0]) >= high - 1 and np.degrees(
        grid.elevations[-1] - grid.wander) <= low + 1


def test_without_ground_in_sight_the_mount_is_not_known():
    m = of(all_changed(lambda p: p[p["z"] > 0.3]))
    assert m.mount is None and said(m, "no ground in sight", "sensor_pose")


def test_millimetres_two_dimensions_few_points_and_mixed_layouts_are_refused():
    def in_millimetres(points):
        for axis in "xyz":
            points[axis] *= 1000
        return points

    def on_a_map(points):
        points["x"], points["y"] = points["x"] + 300, points["y"] - 300
        return points

    for change, named in ((in_millimetres, "millimetres"), (on_a_map, "frame such as map"),
                          (lambda p: p[:50], "50 usable points")):
        with pytest.raises(InputError, match=named) as error:
            scan_of(changed(messages()[0], change))
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="2D scanner"):
        of(all_changed(lambda p: p[p["ring"] == 8]))
    mixed = all_changed(None)
    with pytest.raises(InputError, match="several layouts"):
        of([mixed[0]._replace(columns=("x", "y", "z")), *mixed[1:]])
    m = of(mixed)
    high = replace(m, mount=m.mount._replace(height=60.0))
    with pytest.raises(InputError, match=r"height = 60\.0 is outside 0\.0 \.\. 50\.0 m; give"):
        params_yaml(high)


def test_several_frames_gaps_and_stamps_that_jump_are_said():
    scans = [scan._replace(frame_id=f"lidar_{i % 2}") for i, scan in enumerate(all_changed(None))]
    stamps = np.arange(100) * 10**8
    lossy = np.delete(stamps, [20, 21, 50])
    m = of(scans, stamps=lossy)
    assert said(m, "several frames") and said(m, "3 clouds are missing")
    assert (m.timing.gaps, m.timing.missing) == (2, 3) and m.timing.rate == pytest.approx(10)
    back = timing_of(scans, np.concatenate([stamps, stamps]))
    assert back.backwards == 1 and back.missing == 0
    drives = timing_of(scans, np.concatenate([stamps, stamps + 10**12]))
    assert drives.missing == 0


@pytest.mark.parametrize("values, full, sure", [
    (np.linspace(0, 0.99, 500), 1.0, True), (np.arange(256.0), 255.0, True),
    (np.arange(120.0), 255.0, False), (np.arange(30.0), 255.0, False),
    (np.linspace(0, 99.5, 999), 100.0, True), (np.arange(60000.0), 65535.0, True)])
def test_the_scale_of_intensities(values, full, sure):
    scan = replace_intensity(all_changed(None)[0], values)
    found = intensity_of([scan])
    assert (found.full, found.sure) == (full, sure)
    assert intensity_of([scan._replace(intensity=None)]) is None
    assert intensity_of([scan._replace(intensity=np.zeros(9))]) is None


def test_whether_intensities_are_whole_is_told_by_all_scans_and_the_nearest_return_counts():
    scan = all_changed(None)[0]
    dark = replace_intensity(scan, np.zeros(20_000))
    assert not intensity_of([dark, replace_intensity(scan, np.linspace(0, 0.9, 9_000))]).whole
    m = of(all_changed(None))
    assert m.model and sensor_of(replace(m, least=0.4)).min_range == 0.4


def replace_intensity(scan, values):
    return scan._replace(intensity=values)


def test_what_was_measured_never_changes_what_was_given():
    scans = all_changed(None)
    before = [scan.xyz.copy() for scan in scans]
    m = of(scans)
    doubts(replace(m, model=""))
    assert all(np.array_equal(a, s.xyz) for a, s in zip(before, scans))
