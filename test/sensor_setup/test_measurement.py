"""Measurements of simulated tilted sensors and of real sensors agree with the truth."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from tilted_samples import BARE, MOUNTS, simulate_clouds

from lidar_perception.data.raw_clouds import choose_clouds, open_clouds
from lidar_perception.sensor_setup.measurement.beams import Beams, find_beams
from lidar_perception.sensor_setup.measurement.measure import find_matching_model, measure_sensor
from lidar_perception.sensor_setup.measurement.mount import find_ground_plane, measure_mount
from lidar_perception.sensor_setup.measurement.scans import measure_intensity, read_scan
from lidar_perception.sensor_setup.report.files import format_params, format_sensor
from lidar_perception.sensor_setup.report.params import choose_params
from lidar_perception.sensor_setup.report.values import list_values
from lidar_perception.sensor_setup.report.warnings import find_warnings
from lidar_perception.simulation.sensor import SENSOR_NAMES, find_sensor, load_sensor
from lidar_perception.wire.params import InputParams

CHECKED = ("hdl-64e", "vlp-16", "pandarxt-32")  # beams by order, by ring column, and by elevation


@cache
def simulate_scans(name):
    return tuple(read_scan(msg) for msg in simulate_clouds(name))


@cache
def measure_simulated_sensor(name):
    return measure_sensor(simulate_scans(name), [0, 1, 10, 11], name, 12, None)


@pytest.mark.parametrize("name", CHECKED)
def test_tilted_sensor_is_measured_correctly(name):
    m, sensor = measure_simulated_sensor(name), find_sensor(name)
    driver, roll, pitch, height = MOUNTS[name]
    pattern, mount = m.pattern, m.mounting.mount
    assert len(pattern.beams.elevations) == sensor.rings and pattern.model == name
    assert np.abs(pattern.beams.elevations - np.degrees(sensor.elevations)).max() < 0.05
    assert np.allclose(pattern.beams.lifts, sensor.lifts or 0.0, atol=0.005)
    assert pattern.azimuth_step == pytest.approx(360 / sensor.columns, rel=0.02)
    assert pattern.range_noise == pytest.approx(sensor.range_noise, rel=0.3)
    assert mount.height == pytest.approx(height, abs=0.02)
    assert np.degrees([mount.roll, mount.pitch]) == pytest.approx([roll, pitch], abs=0.2)
    assert m.mounting.heading.degrees == pytest.approx(0, abs=10)
    assert m.view.coverage.stationary is False
    for kind in ("intensity", "ring", "time"):
        column = driver[kind]
        assert (column[0] if column else f"no {kind}") in next(
            row.value for row in list_values(m) if row.name == "columns"
        )
    if driver["intensity"]:
        assert m.intensity.full_scale == driver["intensity"][2] and m.intensity.is_certain
        assert m.intensity.zero_fraction == pytest.approx(
            float(np.mean(np.concatenate([s.intensity for s in m.source.scans]) == 0))
        )
    if driver["time"]:
        assert m.timing.rate == pytest.approx(sensor.rate, rel=0.01)


def test_sensor_file_describes_the_measured_sensor(tmp_path):
    for name in CHECKED:
        path = tmp_path / f"{name}.yaml"
        path.write_text(format_sensor(measure_simulated_sensor(name)))
        sensor, known = load_sensor(path), find_sensor(name)
        assert sensor.columns == known.columns and sensor.divergence == pytest.approx(known.divergence, abs=1e-6)
        assert np.allclose(sensor.elevations, known.elevations, atol=np.radians(0.05))
        assert sensor.height == pytest.approx(MOUNTS[name][3], abs=0.02)
        assert sensor.min_range == known.min_range  # not the distance of the nearest ground


def test_horizontal_slice_of_a_wall_is_not_taken_for_ground():
    rng = np.random.default_rng(0)
    ground = rng.uniform([-25, -25, 1.71], [25, 25, 1.75], (20000, 3))
    wall = rng.uniform([4, -3, -0.28], [9, 3, -0.24], (150, 3))
    scans = [SimpleNamespace(xyz=np.concatenate(parts).astype(np.float32)) for parts in ([ground, wall],) * 3]
    assert find_ground_plane(scans[0].xyz, True) is not None
    mount = measure_mount(scans)
    assert mount.upside_down and mount.height == pytest.approx(1.73, abs=0.01)
    indoors = [SimpleNamespace(xyz=(s.xyz * [1, 1, -1]).astype(np.float32)) for s in scans]
    ceiling = rng.uniform([-25, -25, 2.2], [25, 25, 2.24], (20000, 3))
    indoors = [SimpleNamespace(xyz=np.concatenate([s.xyz, ceiling]).astype(np.float32)) for s in indoors]
    assert not measure_mount(indoors).upside_down


def test_known_model_gets_all_beams_from_a_partial_view(tmp_path):
    partial_scans = tuple(
        s._make(column[s.ring > 1] if isinstance(column, np.ndarray) else column for column in s)
        for s in simulate_scans("vlp-16")
    )
    m = measure_sensor(partial_scans, [0, 1, 10, 11], "part", 12, None)
    (tmp_path / "sensor.yaml").write_text(format_sensor(m))
    assert len(m.pattern.beams.elevations) == 14
    assert "14 of the 16 beams" in " ".join(find_warnings(m))
    assert load_sensor(tmp_path / "sensor.yaml").elevations == pytest.approx(find_sensor("vlp-16").elevations)


@pytest.mark.parametrize("name", SENSOR_NAMES)
def test_model_is_recognised_by_its_beams(name):
    sensor = find_sensor(name)
    up = np.degrees(sensor.elevations)
    beams = Beams(up, 0 * up, 0 * up, 0 * up, [], "ring")
    number = np.arange(len(up))
    for elevations in up, up[number % 7 != 3], up + 0.05 * (-1) ** number:
        assert find_matching_model(beams._replace(elevations=elevations)) == ("" if sensor.wander else name)
    for half, rows in ((12.5, 126), (11.25, 112), (12.5, 60)):
        assert not find_matching_model(beams._replace(elevations=np.linspace(half, -half, rows)))


def test_height_hint_is_used_without_ground():
    m = measure_simulated_sensor("vlp-16")
    m = replace(m, mounting=m.mounting._replace(mount=None, heading=None, height_hint=0.7))
    assert "height: 0.7  # from --height-hint" in format_sensor(m)
    assert "height: 0.7" in format_params(m)


def test_beams_from_rings_and_from_elevations_agree():
    with_rings = simulate_scans("vlp-16")
    by_ring, by_elevation = (find_beams(s) for s in (with_rings, [scan._replace(ring=None) for scan in with_rings]))
    assert (by_ring.method, by_elevation.method) == ("ring", "elevation")
    assert np.abs(by_ring.elevations - by_elevation.elevations).max() < 1e-3
    assert np.mean(by_ring.labels[0] == by_elevation.labels[0]) > 0.999
    one_label_each = {(int(a), int(b)) for a, b in zip(with_rings[0].ring, by_ring.labels[0])}
    assert len(one_label_each) == 16


def test_scan_lines_of_non_repeating_pattern_are_not_beams():
    """The four scan lines of a Livox sweep the entire view; here all returns are from a ceiling."""
    rng = np.random.default_rng(0)
    changed_scans = []
    for scan in simulate_scans("vlp-16"):
        away, aside = rng.uniform(2, 12, len(scan.xyz)), np.radians(scan.azimuth)
        xyz = np.column_stack(
            [away * np.cos(aside), away * np.sin(aside), 2 - 0.02 * away + rng.normal(0, 0.01, len(away))]
        )
        changed_scans.append(
            scan._replace(
                xyz=xyz,
                ground_range=away,
                ring=np.arange(len(away)) % 4,
                elevation=np.degrees(np.arctan2(xyz[:, 2], away)),
            )
        )
    assert find_beams(changed_scans) is None


def test_sparse_sensor_gets_wider_neighbourhoods():
    sparse, dense = (format_params(measure_simulated_sensor(name)) for name in ("vlp-16", "hdl-64e"))
    assert "eps: [0.5, 0.7, 0.9, 1.0]" in sparse and "min_samples: 3" in sparse
    assert "eps: [0.15, 0.3, 0.5, 0.7]" not in sparse and "min_samples: 10" in dense


def test_cloud_without_columns_warns():
    assert MOUNTS["pandarxt-32"][0] is BARE
    m = measure_simulated_sensor("pandarxt-32")
    text = "\n".join(find_warnings(m))
    assert "the clouds have no intensity" in text and "the rate is unknown" in text
    assert "silent: 1  # no intensity in the clouds" in format_sensor(m)
    assert "input.intensity_max" not in choose_params(m)


def test_constant_intensities_are_read_as_0():
    m = measure_simulated_sensor("pandarxt-32")
    scans = tuple(s._replace(intensity=np.full(len(s.xyz), 255.0)) for s in m.source.scans)
    same = replace(m, source=m.source._replace(scans=scans))
    full, _ = choose_params(same)["input.intensity_max"]
    assert 255 / InputParams(full).intensity_max < 1e-6
    assert measure_intensity(scans) is None and "silent: 1" in format_sensor(same)


@pytest.mark.parametrize(
    "folder, model, height, rings",
    [
        ("kitti_tracking", "hdl-64e", 1.73, 64),
        ("nuscenes/unlabelled", "hdl-32e", 1.84, 32),
        ("sensors/vlp16.pcd", "vlp-16", None, 16),
        ("sensors/xt32.pcd", "pandarxt-32", None, 32),
        ("sensors/pandar64.pcd", "pandar64", None, 64),
    ],
)
def test_real_sensors_are_recognised(data, folder, model, height, rings):
    clouds = open_clouds(data / folder)
    numbers = choose_clouds(clouds.count, 4)
    scans = [read_scan(clouds.load(i)) for i in numbers]
    m = measure_sensor(scans, numbers, folder, clouds.count, None)
    assert m.pattern.model == model and rings - 2 <= len(m.pattern.beams.elevations) <= rings
    step = np.degrees(find_sensor(model).azimuth_step)
    assert m.pattern.azimuth_step == pytest.approx(step, rel=0.05)
    if height is None:  # an indoor sensor on a table
        assert m.mounting.mount is None and any("no ground" in line for line in find_warnings(m))
    else:
        assert m.mounting.mount.height == pytest.approx(height, abs=0.1)
