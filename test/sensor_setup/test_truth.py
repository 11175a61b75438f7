"""Simulated sensors that lean are measured as they are; real ones as they are known."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from tilted_samples import BARE, MOUNTS, clouds_of

from lidar_perception.data.raw_clouds import choose_clouds, open_clouds
from lidar_perception.sensor_setup.beams import Beams, beams_of
from lidar_perception.sensor_setup.doubts import doubts
from lidar_perception.sensor_setup.files import chosen_params, params_yaml, sensor_yaml
from lidar_perception.sensor_setup.findings import findings
from lidar_perception.sensor_setup.measure import measured, model_of
from lidar_perception.sensor_setup.mount import ground_plane, mount_of
from lidar_perception.sensor_setup.scans import intensity_of, scan_of
from lidar_perception.simulation.sensor import NAMES, sensor_from_file, sensor_named
from lidar_perception.wire.params import InputParams

CHECKED = ("hdl-64e", "vlp-16", "pandarxt-32")  # by the order, by rings, and by elevations


@cache
def scans(name):
    return tuple(scan_of(msg) for msg in clouds_of(name))


@cache
def found(name):
    return measured(scans(name), [0, 1, 10, 11], name, 12, None)


@pytest.mark.parametrize("name", CHECKED)
def test_a_sensor_that_leans_is_measured_as_it_is(name):
    m, sensor = found(name), sensor_named(name)
    driver, roll, pitch, height = MOUNTS[name]
    assert len(m.beams.elevations) == sensor.rings and m.model == name
    assert np.abs(m.beams.elevations - np.degrees(sensor.elevations)).max() < 0.05
    assert np.allclose(m.beams.lifts, sensor.lifts or 0.0, atol=0.005)
    assert m.step == pytest.approx(360 / sensor.columns, rel=0.02)
    assert m.noise == pytest.approx(sensor.range_noise, rel=0.3)
    assert m.mount.height == pytest.approx(height, abs=0.02)
    assert np.degrees([m.mount.roll, m.mount.pitch]) == pytest.approx([roll, pitch], abs=0.2)
    assert m.heading[0] == pytest.approx(0, abs=10) and m.coverage.still is False
    for what in ("intensity", "ring", "time"):
        column = driver[what]
        assert (column[0] if column else f"no {what}") in next(
            f.how for f in findings(m) if f.what == "columns")
    if driver["intensity"]:
        assert m.intensity.full == driver["intensity"][2] and m.intensity.sure
        assert m.intensity.zeros == pytest.approx(float(np.mean(np.concatenate(
            [s.intensity for s in m.scans]) == 0)))
    if driver["time"]:
        assert m.timing.rate == pytest.approx(sensor.rate, rel=0.01)
        assert m.timing.turns == "clockwise"


def test_the_file_that_is_written_is_the_sensor_that_was_measured(tmp_path):
    for name in CHECKED:
        path = tmp_path / f"{name}.yaml"
        path.write_text(sensor_yaml(found(name)))
        sensor, known = sensor_from_file(path), sensor_named(name)
        assert sensor.columns == known.columns and sensor.divergence == pytest.approx(
            known.divergence, abs=1e-6)
        assert np.allclose(sensor.elevations, known.elevations, atol=np.radians(0.05))
        assert sensor.height == pytest.approx(MOUNTS[name][3], abs=0.02)
        assert sensor.min_range == known.min_range  # and not the nearest ground of this drive


def test_a_slice_of_a_wall_is_no_ground_under_an_upside_down_sensor():
    rng = np.random.default_rng(0)
    ground = rng.uniform([-25, -25, 1.71], [25, 25, 1.75], (20000, 3))
    wall = rng.uniform([4, -3, -0.28], [9, 3, -0.24], (150, 3))
    seen = [SimpleNamespace(xyz=np.concatenate(parts).astype(np.float32))
            for parts in ([ground, wall],) * 3]
    assert ground_plane(seen[0].xyz, True) is not None
    mount = mount_of(seen)
    assert mount.upside_down and mount.height == pytest.approx(1.73, abs=0.01)
    indoors = [SimpleNamespace(xyz=(s.xyz * [1, 1, -1]).astype(np.float32)) for s in seen]
    ceiling = rng.uniform([-25, -25, 2.2], [25, 25, 2.24], (20000, 3))
    indoors = [SimpleNamespace(xyz=np.concatenate([s.xyz, ceiling]).astype(np.float32))
               for s in indoors]
    assert not mount_of(indoors).upside_down


def test_of_a_model_that_is_seen_in_part_all_beams_are_written(tmp_path):
    seen = tuple(s._make(column[s.ring > 1] if isinstance(column, np.ndarray) else column
                         for column in s) for s in scans("vlp-16"))
    m = measured(seen, [0, 1, 10, 11], "part", 12, None)
    (tmp_path / "sensor.yaml").write_text(sensor_yaml(m))
    assert len(m.beams.elevations) == 14 and "14 of the 16 beams" in " ".join(doubts(m))
    assert sensor_from_file(tmp_path / "sensor.yaml").elevations == pytest.approx(
        sensor_named("vlp-16").elevations)


@pytest.mark.parametrize("name", NAMES)
def test_a_model_is_known_by_its_beams_and_no_other_sensor_is_taken_for_it(name):
    sensor = sensor_named(name)
    up = np.degrees(sensor.elevations)
    of = Beams(up, 0 * up, 0 * up, 0 * up, [], "ring")
    known = "" if sensor.wander else name
    assert model_of(of)[0] == model_of(of._replace(elevations=up[np.arange(len(up)) % 7 != 3]))[
        0] == model_of(of._replace(elevations=up + 0.05 * (-1) ** np.arange(len(up))))[0] == known
    for half, rows in ((12.5, 126), (11.25, 112), (12.5, 60)):
        assert not model_of(of._replace(elevations=np.linspace(half, -half, rows)))[0]


def test_a_height_that_is_given_counts_where_no_ground_is_seen():
    m = replace(found("vlp-16"), mount=None, heading=None, hint=0.7)
    assert "height: 0.7  # as --height-hint says" in sensor_yaml(m)
    assert "height: 0.7" in params_yaml(m)


def test_beams_are_the_same_by_rings_and_by_elevation():
    with_rings = scans("vlp-16")
    by_ring, by_elevation = (beams_of(s) for s in (
        with_rings, [scan._replace(ring=None) for scan in with_rings]))
    assert (by_ring.how, by_elevation.how) == ("ring", "elevation")
    assert np.abs(by_ring.elevations - by_elevation.elevations).max() < 1e-3
    assert np.mean(by_ring.labels[0] == by_elevation.labels[0]) > 0.999
    one_label_each = {(int(a), int(b)) for a, b in zip(with_rings[0].ring, by_ring.labels[0])}
    assert len(one_label_each) == 16


def test_lines_of_a_pattern_that_does_not_repeat_are_no_beams():
    """As of a Livox, whose four lines look everywhere, indoors: all meet the ceiling."""
    rng = np.random.default_rng(0)
    found = []
    for scan in scans("vlp-16"):
        away, aside = rng.uniform(2, 12, len(scan.xyz)), np.radians(scan.azimuth)
        xyz = np.column_stack([away * np.cos(aside), away * np.sin(aside),
                               2 - 0.02 * away + rng.normal(0, 0.01, len(away))])
        found.append(scan._replace(xyz=xyz, ground_range=away, ring=np.arange(len(away)) % 4,
                                   elevation=np.degrees(np.arctan2(xyz[:, 2], away))))
    assert beams_of(found) is None


def test_a_sparser_sensor_gets_wider_neighbourhoods_and_fewer_points():
    sparse, dense = (params_yaml(found(name)) for name in ("vlp-16", "hdl-64e"))
    assert "eps: [0.5, 0.7, 0.9, 1.0]" in sparse and "min_samples: 3" in sparse
    assert "eps: [0.15, 0.3, 0.5, 0.7]" not in sparse and "min_samples: 10" in dense


def test_a_bare_cloud_says_what_it_lacks():
    assert MOUNTS["pandarxt-32"][0] is BARE
    m = found("pandarxt-32")
    text = "\n".join(doubts(m))
    assert "there is no intensity" in text and "the rate cannot be told" in text
    assert "silent: 1  # no intensity was seen" in sensor_yaml(m)
    assert "input.intensity_max" not in chosen_params(m)


def test_intensities_that_never_change_are_read_as_0_as_sensor_yaml_has_them():
    m = found("pandarxt-32")
    same = replace(m, scans=tuple(s._replace(intensity=np.full(len(s.xyz), 255.0))
                                  for s in m.scans))
    full, _ = chosen_params(same)["input.intensity_max"]
    assert 255 / InputParams(full).intensity_max < 1e-6
    assert intensity_of(same.scans) is None and "silent: 1" in sensor_yaml(same)


@pytest.mark.parametrize("folder, model, height, rings", [
    ("kitti_tracking", "hdl-64e", 1.73, 64), ("nuscenes/unlabelled", "hdl-32e", 1.84, 32),
    ("sensors/vlp16.pcd", "vlp-16", None, 16), ("sensors/xt32.pcd", "pandarxt-32", None, 32),
    ("sensors/pandar64.pcd", "pandar64", None, 64)])
def test_real_sensors_are_known_by_their_beams(data, folder, model, height, rings):
    clouds = open_clouds(data / folder)
    numbers = choose_clouds(clouds.count, 4)
    m = measured([scan_of(clouds.load(i)) for i in numbers], numbers, folder, clouds.count, None)
    assert m.model == model and rings - 2 <= len(m.beams.elevations) <= rings
    assert m.step == pytest.approx(np.degrees(sensor_named(model).azimuth_step), rel=0.05)
    if height is None:  # indoors, on a table
        assert m.mount is None and any("no ground" in line for line in doubts(m))
    else:
        assert m.mount.height == pytest.approx(height, abs=0.1)
