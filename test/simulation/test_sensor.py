"""Sensor models and returns."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from lidar_perception.simulation.raycast import Hits
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.sensor import (
    HDL64E,
    NO_MOTION,
    SENSOR_NAMES,
    Motion,
    Sensor,
    find_sensor,
    load_sensor,
    make_generic_sensor,
    make_rays,
)
from lidar_perception.simulation.solids import RETROREFLECTOR
from lidar_perception.simulation.terrain import compute_brightness
from lidar_perception.types import InputError

SMALL = make_generic_sensor(8, -10.0, 4.0, 0.5, 10.0)


def make_hits(sensor, distance, brightness=0.3, cosine=1.0):
    """Return hits for all rays; distance and brightness are numbers or arrays (columns, rings)."""
    shape = sensor.columns, sensor.rings
    return Hits(
        np.broadcast_to(np.asarray(distance, float), shape),
        np.broadcast_to(np.asarray(brightness, float), shape),
        np.broadcast_to(cosine, shape),
        np.ones(shape, np.int32),
        np.full(shape, 10, np.uint16),
        np.zeros(shape, np.int32),
        np.array([0, 1]),
    )


def make_measurement(sensor, distance, brightness=0.3, motion=NO_MOTION, seed=0, cosine=1.0, **flags):
    return make_returns(
        make_hits(sensor, distance, brightness, cosine), sensor, motion, np.random.default_rng(seed), **flags
    )


@pytest.mark.parametrize("name", SENSOR_NAMES)
def test_presets_have_plausible_values(name):
    sensor = find_sensor(name)
    direction = sensor.compute_directions()
    assert direction.shape == (sensor.columns, sensor.rings, 3)
    assert np.allclose(np.linalg.norm(direction, axis=2), 1)
    assert np.allclose(direction[0, :, 1], 0) and (direction[0, :, 0] > 0).all()
    assert (np.diff(direction[..., 2], axis=1) < 0).all()
    assert name.endswith(str(sensor.rings)) or name in ("hdl-64e", "hdl-32e", "vlp-32c", "pandar64", "livox-mid360")
    times = sensor.compute_firing_times()
    assert times.min() == 0 and times.max() < 1 / sensor.rate
    assert len(np.unique(times)) == sensor.columns


def test_hdl_64e_preset_matches_kitti():
    assert (HDL64E.height, HDL64E.columns, HDL64E.rate) == (1.73, 2140, 10.0)
    assert abs(np.degrees(HDL64E.azimuth_step) - 0.168) < 1e-3


@pytest.mark.parametrize(
    "change, message",
    [
        ({"elevations": ()}, "elevations"),
        ({"elevations": (0.1, 0.2)}, "elevations"),
        ({"elevations": tuple(np.linspace(1, -1, 70_000)), "azimuth_step": 1.5}, "65536 beams"),
        ({"elevations": (2.0,)}, "elevations"),
        ({"elevations": (np.nan,)}, "elevations"),
        ({"lifts": (0.1,)}, "lifts"),
        ({"biases": (0.1,)}, "biases"),
        ({"offsets": (0.1,)}, "offsets"),
        ({"azimuth_step": 0.0}, "azimuth_step"),
        ({"azimuth_step": np.nan}, "azimuth_step"),
        ({"height": 0.0}, "height"),
        ({"max_range": 0.5}, "max_range"),
        ({"min_range": -1}, "max_range"),
        ({"rate": 0.0}, "rate"),
        ({"reach": 0.0}, "reach"),
        ({"dropout": 1.5}, "dropout"),
        ({"range_noise": -0.1}, "range_noise"),
        ({"divergence": np.inf}, "divergence"),
        ({"wander": -0.1}, "wander"),
        ({"wander": 1.5}, "wander"),
        ({"pulse": -1.0}, "pulse"),
        ({"fade": (np.nan, 0)}, "fade"),
    ],
)
def test_impossible_sensors_are_rejected(change, message):
    with pytest.raises(InputError, match=message) as error:
        replace(SMALL, **change)
    assert "\n" not in str(error.value)


def test_bad_generic_sensors_and_unknown_names_are_rejected():
    for arguments in ((0, -10, 10), (16, 10, -10), (16, -95, 10)):
        with pytest.raises(InputError):
            make_generic_sensor(*arguments, 0.2, 10.0)
    with pytest.raises(InputError, match="hdl-64e"):
        find_sensor("hdl128")


def test_sensor_names_are_accepted_in_any_spelling():
    assert find_sensor("os1_64") == find_sensor("OS1-64") != find_sensor("os1-128")
    assert find_sensor("hdl64e") == find_sensor("HDL-64E") == HDL64E


def test_angles_of_a_sensor_file_are_in_degrees(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(
        "name: mine\nelevations: [4, 0, -10.5]\nazimuth_step: 0.5\nrate: 10\n"
        "divergence: 0.2\nfade: [10, 0.1]\nblocked:\n- [1, 350, 10]\nwander: 2\n"
    )
    assert (
        load_sensor(path)
        == find_sensor(str(path))
        == Sensor(
            tuple(np.radians([4.0, 0.0, -10.5])),
            np.radians(0.5),
            rate=10.0,
            divergence=np.radians(0.2),
            fade=(10.0, 0.1),
            blocked=((1, 350.0, 10.0),),
            wander=np.radians(2.0),
        )
    )


@pytest.mark.parametrize(
    "text, message",
    [
        ("[1, 2", "not valid YAML"),
        ("rate: 2024-13-45", "not valid YAML"),
        ("rate: " + "1" * 5000, "not valid YAML"),
        ("- 1", "does not describe a sensor"),
        ("azimuth_step: 1", "elevations"),
        ("elevations: [1]\nazimuth_step: 1\nrate: 10\nbeams: 3", "unknown field 'beams'; choose from"),
        ("elevations: 3\nazimuth_step: 1\nrate: 10", "elevations = 3 must be a list of numbers"),
        ("elevations: [1]\nazimuth_step: yes\nrate: 10", "azimuth_step = True must be a number"),
        ("elevations: [1]\nazimuth_step: 1\nrate: 10\nfade: [1]", "fade"),
        ("elevations: [1]\nazimuth_step: 1\nrate: 10\nblocked: [1, 2, 3]", "blocked"),
        ("elevations: [a]\nazimuth_step: 1\nrate: 10", "elevations"),
        ("elevations: [1, 2]\nazimuth_step: 1\nrate: 10", "descend"),
        ("elevations: [1]\nazimuth_step: 0\nrate: 10", "azimuth_step"),
        ("elevations: [1]\nazimuth_step: 1\nrate: .inf", "rate"),
        ("elevations: [1]\nazimuth_step: 1\nrate: 1" + "0" * 400, "rate"),
        ("elevations: " + "[" * 5000 + "]" * 5000 + "\nazimuth_step: 1\nrate: 10", "elevations"),
        ("elevations: [1]\nazimuth_step: 1\nrate: 10\nfade: []", "fade"),
        ("elevations: [1]\nazimuth_step: 1\nrate: 10\nblocked: [[.inf, 0, 10]]", "blocked"),
        ("elevations: [1]\nazimuth_step: 1\nrate: 10\nblocked: [[0.5, 0, 10]]", "blocked"),
    ],
)
def test_error_names_the_bad_sensor_file_and_the_reason(tmp_path, text, message):
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as error:
        load_sensor(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_beam_wander_is_uniformly_distributed():
    sensor = replace(SMALL, wander=np.radians(2.0))
    sensors = [sensor.shift_beams(i) for i in range(50)]
    shifts = np.sort([sensor.elevations[3] - shifted.elevations[3] for shifted in sensors])
    assert SMALL.shift_beams(7) is SMALL and sensors[0] == sensor
    assert 0 <= shifts[0] and shifts[-1] < np.radians(2.0)
    assert np.diff(shifts).max() < np.radians(2.0) / 50 * 2.7


def test_rays_rotate_and_move_with_the_sensor():
    motion = Motion((3.0, -2.0, 0.5), 0.7, stamp=0.25)
    static_rays, moving_rays = make_rays(SMALL), make_rays(SMALL, motion)
    assert np.allclose(moving_rays.times, SMALL.compute_firing_times() - 0.025)
    assert np.allclose(moving_rays.origin[:, 0], moving_rays.times[:, None] * motion.velocity)
    bearing = np.arctan2(moving_rays.direction[..., 1], moving_rays.direction[..., 0])
    before = np.arctan2(static_rays.direction[..., 1], static_rays.direction[..., 0])
    angle_error = (bearing - before - 0.7 * moving_rays.times[:, None] + np.pi) % (2 * np.pi) - np.pi
    assert np.allclose(angle_error, 0)
    assert np.allclose(moving_rays.direction[..., 2], static_rays.direction[..., 2])


def test_returns_have_documented_properties():
    sensor = replace(HDL64E, azimuth_step=np.radians(1.0))
    rng = np.random.default_rng(0)
    shape = sensor.columns, sensor.rings
    returns = make_measurement(sensor, rng.uniform(0, 130, shape), rng.uniform(0, 1, shape))
    n = len(returns.xyz)
    assert n > 1000
    assert [(f.shape, f.dtype) for f in returns] == [
        ((n, 3), np.float32),
        ((n,), np.float32),
        ((n,), np.int32),
        ((n,), np.uint16),
        ((n,), np.uint16),
        ((n,), np.float32),
    ]
    ranges = np.linalg.norm(returns.xyz - [0, 0, 0.16], axis=1)
    assert ranges.min() > sensor.min_range - 0.06 and ranges.max() < sensor.max_range + 0.06
    assert returns.intensity.min() >= 0 and returns.intensity.max() <= 1
    hundredths = returns.intensity * 100
    assert np.abs(hundredths - np.round(hundredths)).max() < 1e-4
    assert (np.diff(returns.ring.astype(int)) >= 0).all()  # beam by beam
    bearing = np.arctan2(returns.xyz[:, 1], returns.xyz[:, 0]) % (2 * np.pi)
    assert (np.diff(bearing)[np.diff(returns.ring) == 0] > -1e-5).all()


def test_ring_matches_elevation_and_time_matches_azimuth():
    returns = make_measurement(SMALL, 30.0)
    rise = returns.xyz[:, 2] / np.linalg.norm(returns.xyz, axis=1)
    assert np.allclose(np.arcsin(rise), np.array(SMALL.elevations)[returns.ring], atol=1e-5)
    column = np.round(np.arctan2(returns.xyz[:, 1], returns.xyz[:, 0]) / (2 * np.pi) * SMALL.columns)
    assert np.allclose(returns.time, make_rays(SMALL).times[column.astype(int) % SMALL.columns])


def test_range_noise_has_standard_deviation_of_sensor():
    returns = make_measurement(replace(SMALL, range_noise=0.05), 20.0)
    assert abs((np.linalg.norm(returns.xyz, axis=1) - 20).std() - 0.05) < 0.003


def test_offsets_shift_ranges_per_beam():
    offsets = tuple(np.linspace(-0.05, 0.05, 8))
    returns = make_measurement(replace(SMALL, offsets=offsets), 20.0)
    for ring, offset in enumerate(offsets):
        ranges = np.linalg.norm(returns.xyz[returns.ring == ring], axis=1)
        assert abs(ranges.mean() - 20 - offset) < 0.01
    assert 0.01 < np.std(HDL64E.offsets[:39]) < 0.03


def test_far_and_dark_returns_are_lost():
    open_sensor = replace(SMALL, dropout=0.0)
    fraction = {
        (r, b): len(make_measurement(open_sensor, r, b).xyz) / SMALL.columns / SMALL.rings
        for r in (5, 25, 50, 100)
        for b in (0.03, 0.1, 0.4, 0.9)
    }
    for b in (0.03, 0.1, 0.4, 0.9):
        assert fraction[5, b] >= fraction[25, b] >= fraction[50, b] >= fraction[100, b]
    for r in (5, 25, 50, 100):
        assert fraction[r, 0.03] <= fraction[r, 0.1] <= fraction[r, 0.4] <= fraction[r, 0.9]
    assert fraction[5, 0.1] == 1 and abs(fraction[50, 0.1] - 0.5) < 0.1
    assert abs(fraction[100, 0.4] - 0.5) < 0.1  # power is proportional to brightness / range^2
    assert len(make_measurement(open_sensor, 5.0, 0.0).xyz) == 0 and not len(make_measurement(SMALL, np.inf).xyz)
    assert len(make_measurement(SMALL, 50.0, cosine=0.05).xyz) < len(make_measurement(SMALL, 50.0).xyz)
    lost_fraction = 1 - len(make_measurement(replace(SMALL, dropout=0.2), 5.0).xyz) / SMALL.columns / SMALL.rings
    assert abs(lost_fraction - 0.2) < 0.03


def test_infinite_reach_keeps_every_hit():
    sensor = replace(SMALL, reach=np.inf, dropout=0.0)
    distance = np.where(np.arange(sensor.columns) % 2, np.inf, 100.0)[:, None]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        returns = make_measurement(sensor, distance, np.where(np.isinf(distance), 0.0, 1e-6))
    assert len(returns.xyz) == sensor.columns * sensor.rings / 2


def test_intensity_follows_brightness_bias_and_fade():
    plain = make_measurement(SMALL, 10.0, 0.4)
    assert abs(plain.intensity.mean() - 0.4) < 0.005
    faded = make_measurement(replace(SMALL, fade=(18.0, 0.01)), 28.0, 0.4)
    assert abs(faded.intensity.mean() - 0.3) < 0.005
    biases = tuple(np.linspace(-0.1, 0.1, 8))
    biased = make_measurement(replace(SMALL, biases=biases), 10.0, 0.4)
    for ring, bias in enumerate(biases):
        assert abs(biased.intensity[biased.ring == ring].mean() - 0.4 - bias) < 0.01


def test_only_weak_returns_have_intensity_0():
    sensor = replace(SMALL, floor=0.2, biases=(0.1,) * 8)
    assert (make_measurement(sensor, 10.0, 0.05).intensity == 0).all()
    assert (make_measurement(sensor, 10.0, 0.4).intensity > 0.2).all()
    on_the_verge = make_measurement(sensor, 10.0, 0.2).intensity
    assert 0.4 < (on_the_verge == 0).mean() < 0.6
    assert on_the_verge[on_the_verge > 0].min() >= 0.3  # no values between 0 and the floor


def test_retroreflectors_do_not_fade():
    sensor = replace(SMALL, fade=(10.0, 0.01))
    assert make_measurement(sensor, 60.0, RETROREFLECTOR).intensity.mean() > 0.95
    assert make_measurement(sensor, 60.0, 0.9).intensity.mean() < 0.45
    assert compute_brightness(RETROREFLECTOR, 0.1) == RETROREFLECTOR
    assert RETROREFLECTOR > 1.2 * compute_brightness(0.99, 0.1)


def test_blocked_sectors_have_no_returns():
    sensor = replace(SMALL, blocked=((4, 350, 10), (6, 90, 120)), dropout=0.0)
    returns = make_measurement(sensor, 10.0)
    bearing = np.degrees(np.arctan2(returns.xyz[:, 1], returns.xyz[:, 0]))
    is_low, is_lower = returns.ring >= 4, returns.ring >= 6
    assert not (is_low & (np.abs(bearing) < 9.9)).any() and (~is_low & (np.abs(bearing) < 9.9)).any()
    on_side = (bearing > 90.1) & (bearing < 119.9)
    assert not (is_lower & on_side).any() and (~is_lower & on_side).any()
    assert isinstance(sensor, Sensor) and len(returns.xyz) == sensor.find_unblocked_rays().sum()


@pytest.mark.parametrize(
    "start, end, degrees", [(0, 360, 360), (-180, 180, 360), (-10, 370, 360), (350, 10, 20), (-10, 10, 20), (10, 10, 0)]
)
def test_blocked_sector_may_cover_360_degrees(start, end, degrees):
    is_blocked = ~replace(SMALL, blocked=((4, start, end),)).find_unblocked_rays()
    assert (is_blocked[:, 4:].sum(axis=0) == 2 * degrees).all() and not is_blocked[:, :4].any()


@pytest.mark.parametrize(
    "name",
    [
        "generic:",
        "generic:32",
        "generic:64,-24,2,1e-9,10",
        "generic:64,-24,2,1e-320,10",
        "generic:1e12,-24,2,0.2,10",
        "generic:inf,-24,2,0.2,10",
        "generic:1000000,-24,2,1,10",
        "generic:70000,-24,2,90,10",
        "generic:32.5,-24,2,1,10",
        "generic:a,b,c,d,e",
        "generic:32,-25,15,0.2,10,3",
        "generic:32,15,-25,0.2,10",
        "generic:0,-25,15,0.2,10",
        "generic:nan,-25,15,0.2,10",
    ],
)
def test_bad_generic_sensor_is_rejected_in_one_line(name):
    with pytest.raises(InputError) as error:
        find_sensor(name)
    assert "\n" not in str(error.value) and re.search("must|expected", str(error.value))
