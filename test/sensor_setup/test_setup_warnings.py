"""Warnings of a measurement with remedies, and rejected clouds."""

import json
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from tilted_samples import simulate_clouds

from lidar_perception.data.raw_clouds import _to_message
from lidar_perception.robot.crop import select_points
from lidar_perception.robot.params import CropParams
from lidar_perception.robot.placement import make_tilted_pose
from lidar_perception.sensor_setup.measurement.coverage import is_stationary
from lidar_perception.sensor_setup.measurement.measure import measure_sensor
from lidar_perception.sensor_setup.measurement.mount import is_on_ground, measure_mount
from lidar_perception.sensor_setup.measurement.recorded_poses import NO_POSES
from lidar_perception.sensor_setup.measurement.scans import Scan, measure_intensity, read_scan
from lidar_perception.sensor_setup.measurement.sensor_model import make_sensor
from lidar_perception.sensor_setup.measurement.timing import measure_timing
from lidar_perception.sensor_setup.report.files import format_params
from lidar_perception.sensor_setup.report.params import choose_params
from lidar_perception.sensor_setup.report.values import list_values
from lidar_perception.sensor_setup.report.warnings import find_warnings
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.simulation.scene import Scenes
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.types import InputError
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array, to_array
from msg_utils.stamps import make_header


@cache
def simulate_messages():
    return tuple(simulate_clouds("vlp-16", 6))


def change_cloud(msg, change, frame_id="lidar"):
    """Return the cloud with its structured array replaced by change(points)."""
    points = to_array(msg).copy()
    points = change(points) if change else points
    return from_array(points, make_header(0, frame_id, make_bag_message), make_bag_message)


def make_rotation(matrix):
    """Return a function that rotates all points of a cloud."""

    def change(points):
        xyz = np.column_stack([points[a] for a in "xyz"]) @ np.transpose(matrix)
        for axis, values in zip("xyz", xyz.T):
            points[axis] = values
        return points

    return change


def measure(scans, numbers=(0, 1, 10, 11, 20, 21), stamps=None):
    return measure_sensor(scans, numbers[: len(scans)], "drive", 22, stamps)


def change_scans(change):
    return [read_scan(change_cloud(msg, change)) for msg in simulate_messages()]


def has_warning(m, *parts):
    return any(all(part in line for part in parts) for line in find_warnings(m))


def test_motion_of_robot_is_recognised():
    scans = change_scans(None)
    one, drives = measure(scans[:1]), measure(scans)
    stationary = measure(scans[:1] * 5, (0, 1, 2, 3, 4))
    assert has_warning(one, "only one cloud", "record") and one.view.coverage.stationary is None
    assert has_warning(stationary, "stands still", "record") and stationary.view.coverage.stationary
    assert not has_warning(drives, "stands still") and not has_warning(drives, "only one cloud")


def test_robot_body_is_found_and_cropped():
    """The body is a curved panel behind the sensor."""
    rng = np.random.default_rng(0)

    def with_body(points):
        new = np.zeros(960, points.dtype)
        new["ring"] = np.tile(np.arange(16), 60)
        up = np.radians(np.linspace(-15, 15, 16))[new["ring"]]
        bearing = np.repeat(np.radians(np.linspace(165.2, 194.8, 60)), 16)
        reach = 0.7 + rng.normal(0, 0.005, 960)
        new["x"], new["y"], new["z"] = (
            reach * np.cos(up) * np.cos(bearing),
            reach * np.cos(up) * np.sin(bearing),
            reach * np.sin(up),
        )
        return np.concatenate([points[np.hypot(points["x"], points["y"]) > 1.0], new])

    m = measure(change_scans(with_body))
    c = m.view.coverage
    assert c.can_crop and c.body.any() and c.foreign_fraction < 0.1
    assert (c.box[:2] < [-0.6, -0.1]).all() and (c.box[3:5] > [-0.7, 0.1]).all()
    assert -0.9 < c.box[0] and c.box[3] < 0 and np.abs(c.box[[2, 5]]).max() < 0.4
    behind = [(a, b) for ring, a, b in c.blocked if ring == 0]
    assert any(a <= 168 and b >= 192 for a, b in behind)
    assert len(measure(change_scans(None)).view.coverage.box) == 0
    # robot.param.yaml also contains the box in base_frame, with a base from TF or on the ground.
    xyz, mount = m.source.scans[0].xyz, m.mounting.mount
    own = xyz[np.hypot(*xyz[:, :2].T) < 1.0]
    by_tf = m.mounting.recorded._replace(footprint=make_tilted_pose(0.1, -0.2, 0.9))
    by_ground = make_tilted_pose(mount.roll, mount.pitch, mount.height)
    for poses, base in ((m.mounting.recorded, by_ground), (by_tf, by_tf.footprint)):
        (line,) = re.findall(r"# body: (.*)", format_params(replace(m, mounting=m.mounting._replace(recorded=poses))))
        assert select_points(own, CropParams(body=tuple(json.loads(line))), base).mean() < 0.02


def simulate_scans(half=np.inf, body=0.0, height=0.6, seed=0, turn=np.eye(3)):
    """Yield 8 scans of a sensor with 16 beams on a robot outdoors with random objects around it. half: distance
    of the walls on both sides; body: distance of the robot's deck behind the sensor, 0 for none; height: sensor
    height, all in m. turn: rotation from the sensor's axes to level ones.
    """
    rng = np.random.default_rng(seed)
    up, aside = np.radians(np.meshgrid(np.arange(-15.0, 16, 2), np.arange(0.0, 360, 0.5)))
    way = np.stack([np.cos(up) * np.cos(aside), np.cos(up) * np.sin(aside), np.sin(up)], axis=-1)
    _, y, z = np.moveaxis(way @ turn.T, -1, 0)
    for _ in range(8):
        things = np.repeat(rng.uniform(5, 50, 72), 10)[:, None]
        reach = np.minimum.reduce(
            [half / np.maximum(np.abs(y), 1e-3), height / np.maximum(-z, 1e-3), np.where(z > 0.2, np.inf, things)]
        )
        reach[(np.abs(aside - np.pi) < 0.4) & (up < 0) & (body > 0)] = body
        hit = np.isfinite(reach)
        yield make_scan(way[hit] * reach[hit, None] + rng.normal(0, 0.005, (hit.sum(), 3)))


def make_trees():
    rng = np.random.default_rng(7)
    foot = rng.uniform(-30, 30, (1500, 2))
    return np.column_stack([np.repeat(foot, 5, axis=0), np.tile(np.linspace(0, 2, 5), 1500)])


def make_scan(xyz):
    r, flat = np.linalg.norm(xyz, axis=1), np.hypot(*xyz[:, :2].T)
    return Scan(
        xyz,
        np.degrees(np.arctan2(xyz[:, 1], xyz[:, 0])) % 360,
        np.degrees(np.arctan2(xyz[:, 2], flat)),
        r,
        flat,
        None,
        None,
        None,
        0,
        "lidar",
        ("x", "y", "z"),
    )


@pytest.mark.parametrize("half", [0.8, 1.1, 2.0])
def test_walls_along_the_path_are_not_robot_body(half):
    m = measure(list(simulate_scans(half)), range(8))
    c = m.view.coverage
    assert c.stationary is False and c.has_walls and not c.can_crop and not c.blocked
    assert has_warning(m, "walls", "crop.body")
    c = measure(list(simulate_scans(body=1.5)), range(8)).view.coverage
    assert c.can_crop and not c.has_walls and c.blocked
    assert c.box[0] == pytest.approx(-1.55, abs=0.05)


def test_passing_people_do_not_mean_robot_motion():
    around = np.random.default_rng(0).uniform(5, 50, (16, 360))
    passed = np.array([np.where(np.arange(360) // 36 == i, 4.5, around) for i in range(10)])
    assert is_stationary(passed)
    assert is_stationary(np.roll(passed, 1, axis=0)[:2]) is not None
    moving = np.array([np.roll(around, 10 * i, axis=1) for i in range(10)])
    assert is_stationary(moving) is False
    scans = list(simulate_scans(body=0.5))
    poses = {i: make_tilted_pose(0, 0, 0.6) for i in range(8)}
    parked = measure_sensor(scans, range(8), "parked", 8, None, NO_POSES._replace(poses=poses))
    assert parked.view.coverage.stationary and has_warning(parked, "stands still")
    assert len(parked.view.coverage.box) and not parked.view.coverage.blocked
    # A slow robot hardly moves between successive clouds.
    numbers = [40 * (i // 2) + i % 2 for i in range(8)]
    slow = [
        make_scan(np.concatenate([scan.xyz[scan.xyz[:, 2] < -0.5], make_trees() - [0.04 * n, 0, 0]]))
        for n, scan in zip(numbers, simulate_scans())
    ]
    m = measure_sensor(slow, numbers, "slow", 160, None)
    assert m.mounting.heading.distance < 0.1 and m.view.coverage.stationary is False


def test_poses_show_motion_on_uniform_ground():
    ground = [
        make_scan(scan.xyz[(scan.xyz[:, 2] < -0.5) | (np.hypot(*scan.xyz[:, :2].T) < 2)])
        for scan in simulate_scans(body=1.5)
    ]
    for distance, drives in ((0.0, False), (4.0, True)):
        poses = {i: make_tilted_pose(0, 0, 0) for i in range(8)}
        poses[7][0, 3] = distance
        m = measure_sensor(ground, range(8), "field", 8, None, NO_POSES._replace(poses=poses))
        assert (m.view.coverage.stationary is False) == drives == m.view.coverage.can_crop
        assert drives != has_warning(m, "stands still")
        assert not has_warning(m, "cannot tell whether the robot moved")


def test_clouds_in_a_ground_frame_are_recognised():
    scans = [make_scan(s.xyz + [0, 0, 0.6]) for s in simulate_scans()]
    assert measure_mount(scans) is None and is_on_ground(scans)
    assert not is_on_ground(list(simulate_scans()))
    m = measure(scans, range(8))
    assert not m.view.coverage.body.any() and has_warning(m, "base_footprint", "driver's own cloud")


@pytest.mark.parametrize("roll, pitch", [(0, 28), (180, -10)])
def test_tilt_does_not_affect_coverage_and_nearest_ground(roll, pitch):
    lean = make_tilted_pose(*np.radians([roll, pitch]))[:3, :3]
    m = measure(list(simulate_scans(turn=lean)), range(8))
    mount = m.mounting.mount
    assert np.degrees(mount.pitch) == pytest.approx(pitch, abs=0.5) and not mount.is_level
    assert m.view.coverage.view == (0, 360) and not make_sensor(m).blocked
    assert has_warning(m, "level sensor")
    nearest = min(np.hypot(*(s.xyz[p.inliers] @ lean.T)[:, :2].T).min() for s, p in zip(m.source.scans, mount.planes))
    assert choose_params(m)["ground.patchwork.min_range"][0] <= nearest


def test_sector_without_returns_limits_the_field_of_view():
    m = measure(change_scans(lambda p: p[np.abs(np.arctan2(p["y"], p["x"])) < np.radians(60)]))
    start, end = m.view.coverage.view
    assert abs(start - 300) <= 1 and abs(end - 60) <= 1
    assert make_sensor(m).find_unblocked_rays().mean() == pytest.approx(1 / 3, abs=0.02)


def test_frame_with_y_ahead_or_z_down_is_reported():
    ahead = measure(change_scans(make_rotation([[0, -1, 0], [1, 0, 0], [0, 0, 1]])))
    assert abs(ahead.mounting.heading.degrees - 90) < 3
    assert has_warning(ahead, f"{ahead.mounting.heading.degrees:.0f} deg", "convert --robot")
    down = measure(change_scans(make_rotation(np.diag([1, -1, -1]))))
    mount = down.mounting.mount
    assert abs(np.degrees(mount.roll)) == pytest.approx(175, abs=0.3)
    assert has_warning(down, "upside down") and mount.height == pytest.approx(0.6, abs=0.02)


@pytest.mark.parametrize("beams", [True, False])
def test_upside_down_sensor_is_described_as_mounted(beams):
    def select_part(points):  # more points below than above the horizon, and on the left
        if not beams:
            points["ring"] = 0
            nearer = np.random.default_rng(0).uniform(0.7, 1.0, len(points))
            points["x"], points["y"] = points["x"] * nearer, points["y"] * nearer
        up = np.arctan2(points["z"], np.hypot(points["x"], points["y"]))
        to = np.arctan2(points["y"], points["x"])
        return points[(up < np.radians(4)) & (to > np.radians(-30))]

    own, other = (
        measure(change_scans(lambda p, axes=axes: make_rotation(np.diag(axes))(select_part(p))))
        for axes in ([1, 1, 1], [1, -1, -1])
    )
    level_sensor, inverted_sensor = make_sensor(own), make_sensor(other)
    np.testing.assert_allclose(inverted_sensor.elevations, level_sensor.elevations, atol=np.radians(0.1))
    np.testing.assert_allclose(inverted_sensor.blocked, level_sensor.blocked, atol=1.01)
    assert inverted_sensor.wander == pytest.approx(level_sensor.wander, rel=0.05)
    assert bool(inverted_sensor.wander) != beams
    if beams:  # beams are denser at the height of people
        up = np.array([14.0, 11, 8, 5, 3, 1, -6, -8, -10, -12, -14])
        assert replace_elevations(own, up).elevation_step == 2
        assert replace_elevations(other, -up[::-1]).elevation_step == 2


def replace_elevations(m, elevations):
    beams = m.pattern.beams._replace(elevations=elevations)
    return replace(m, pattern=m.pattern._replace(beams=beams))


DRIVES = {
    "at a robot's speed": (501, "campus", 0.92, 14, (0, 180, -25)),
    "at a car's": (502, "street", 11.15, 8, (0, 90)),
    "not at all": (504, "campus", 0.0, 6, (90,)),
}


@pytest.mark.parametrize("name", DRIVES)
def test_heading_is_measured_at_low_and_high_speed(name):
    seed, scene, speed, count, angles = DRIVES[name]
    sensor = replace(find_sensor("vlp-16"), height=0.6)
    frames = list(simulate_frames(seed, count, sensor, 40, Scenes(scene=scene)))
    way = np.linalg.norm(frames[-1].pose()[:2, 3] - frames[0].pose()[:2, 3])
    assert way == pytest.approx(speed * (count - 1) / sensor.rate, abs=0.1)
    for degrees in angles:
        a = np.radians(degrees)
        turn = make_rotation([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        scans = [read_scan(change_cloud(_to_message(frame), turn)) for frame in frames]
        m = measure(scans, range(count))
        row = next(value for value in list_values(m) if value.name == "ahead")
        if not speed:
            assert has_warning(m, "yaw unknown: the robot moved only 0.0 m", "record")
            assert row.value == "unknown"
            continue
        assert abs((m.mounting.heading.degrees - degrees + 180) % 360 - 180) < 5
        assert has_warning(m, "drives towards", "input.ahead") == (degrees != 0)
        assert ("input.ahead" in choose_params(m)) == (degrees in (90, -25))
        assert has_warning(m, "backwards") == (degrees == 180) and not has_warning(m, "yaw unknown")
        assert row.confidence == ("low" if degrees else "fair")


def test_rotated_frame_gives_grid_instead_of_beams():
    def level(points):
        points = make_rotation([[0.906, 0, 0.423], [0, 1, 0], [-0.423, 0, 0.906]])(points)
        points["ring"] = 0
        return points

    m = measure(change_scans(level))
    assert m.pattern.beams is None and has_warning(m, "no beams", "grid")
    grid = make_sensor(m)
    low, high = np.percentile(np.concatenate([s.elevation for s in m.source.scans]), [1, 99])
    assert grid.wander > 0 and grid.rings * grid.columns < 60_000
    assert np.degrees(grid.elevations[0]) >= high - 1 and np.degrees(grid.elevations[-1] - grid.wander) <= low + 1


def test_mount_is_unknown_without_ground():
    m = measure(change_scans(lambda p: p[p["z"] > 0.3]))
    assert m.mounting.mount is None and has_warning(m, "no ground in view", "sensor_pose")


def test_unusable_clouds_are_rejected():
    def in_millimetres(points):
        for axis in "xyz":
            points[axis] *= 1000
        return points

    def in_map_frame(points):
        points["x"], points["y"] = points["x"] + 300, points["y"] - 300
        return points

    for change, words in (
        (in_millimetres, "millimetres"),
        (in_map_frame, "frame such as map"),
        (lambda p: p[:50], "50 usable points"),
    ):
        with pytest.raises(InputError, match=words) as error:
            read_scan(change_cloud(simulate_messages()[0], change))
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="2D scanner"):
        measure(change_scans(lambda p: p[p["ring"] == 8]))
    scans = change_scans(None)
    with pytest.raises(InputError, match="different columns"):
        measure([scans[0]._replace(columns=("x", "y", "z")), *scans[1:]])
    m = measure(scans)
    high = replace(m, mounting=m.mounting._replace(mount=m.mounting.mount._replace(height=60.0)))
    with pytest.raises(InputError, match=r"height = 60\.0 is outside 0\.0 \.\. 50\.0 m; use"):
        format_params(high)


def test_mixed_frames_gaps_and_jumping_stamps_are_reported():
    scans = [scan._replace(frame_id=f"lidar_{i % 2}") for i, scan in enumerate(change_scans(None))]
    stamps = np.arange(100) * 10**8
    m = measure(scans, stamps=np.delete(stamps, [20, 21, 50]))
    assert has_warning(m, "several frames") and has_warning(m, "3 clouds are missing")
    assert m.timing.missing_count == 3 and m.timing.rate == pytest.approx(10)
    back = measure_timing(scans, np.concatenate([stamps, stamps]))
    assert back.backward_count == 1 and back.missing_count == 0
    drives = measure_timing(scans, np.concatenate([stamps, stamps + 10**12]))
    assert drives.missing_count == 0


@pytest.mark.parametrize(
    "values, full, sure",
    [
        (np.linspace(0, 0.99, 500), 1.0, True),
        (np.arange(256.0), 255.0, True),
        (np.arange(120.0), 255.0, False),
        (np.arange(30.0), 255.0, False),
        (np.linspace(0, 99.5, 999), 100.0, True),
        (np.arange(60000.0), 65535.0, True),
    ],
)
def test_intensity_scale_is_measured(values, full, sure):
    scan = change_scans(None)[0]._replace(intensity=values)
    found = measure_intensity([scan])
    assert (found.full_scale, found.is_certain) == (full, sure)
    assert measure_intensity([scan._replace(intensity=None)]) is None
    assert measure_intensity([scan._replace(intensity=np.zeros(9))]) is None


def test_integer_intensity_scale_uses_all_scans():
    scan = change_scans(None)[0]
    dark = scan._replace(intensity=np.zeros(20_000))
    bright = scan._replace(intensity=np.linspace(0, 0.9, 9_000))
    assert not measure_intensity([dark, bright]).is_integer
    m = measure(change_scans(None))
    near = replace(m, view=m.view._replace(min_range=0.4))
    assert m.pattern.model and make_sensor(near).min_range == 0.4


def test_measurement_does_not_modify_scans():
    scans = change_scans(None)
    before = [scan.xyz.copy() for scan in scans]
    m = measure(scans)
    find_warnings(replace(m, pattern=m.pattern._replace(model="")))
    assert all(np.array_equal(a, s.xyz) for a, s in zip(before, scans))
