"""Scenes for robots."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from click.testing import CliRunner
from footprint_samples import find_overlaps, make_flat_boxes
from samples import make_any_header

from lidar_perception.cli.simulate import simulate
from lidar_perception.data.open import open_recording
from lidar_perception.data.semantickitti import MOVING
from lidar_perception.data.to_bag import to_point_array
from lidar_perception.sensor_setup.measurement.mount import measure_mount
from lidar_perception.sensor_setup.measurement.scans import read_scan
from lidar_perception.simulation.actors import WIDTH, Actor, ActorSet, Y, footprints_touch, make_prop
from lidar_perception.simulation.camera import find_labelled
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.recording import simulate_frames
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.scene import SCENE_TYPES, Scenes, make_scene
from lidar_perception.simulation.sensor import find_sensor, make_generic_sensor
from lidar_perception.simulation.shapes import furniture
from lidar_perception.simulation.shapes.people import make_pedestrian
from lidar_perception.simulation.terrain import compute_ground_height
from lidar_perception.simulation.trajectory import ROBOT_RADIUS_M, Trajectory, draw_trajectory
from lidar_perception.training.scenes import SimulatedScenes
from lidar_perception.types import CLASSES, InputError
from lidar_perception.wire.codec import make_bag_message
from msg_utils.point_cloud2 import from_array

ROBOTS = [(scene, kind) for scene in ("campus", "indoor") for kind in SCENE_TYPES[scene].kinds]
TINY = make_generic_sensor(16, -15.0, 15.0, 2.0, 10.0, height=0.6)
EXACT = replace(TINY, range_noise=0.0, dropout=0.0, divergence=0.0)
SITTING, GROUND = CLASSES.index("Person_sitting"), (40, 44, 48, 72)
make_cached_scene = cache(lambda scene, kind, seed=2: make_scene(seed, kind, 2.0, scene))


def transform_points(xyz, pose):
    return xyz @ pose[:3, :3].T + pose[:3, 3]


@pytest.mark.parametrize(
    "scenes, seed, moment, points, metres, labels",
    [
        (Scenes(), 1, 0, 2564, 39685.060694, 237.626248434),
        (Scenes("zone", 3.0), 5, 60, 2556, 45710.683241, 719.622602395),
    ],
)
def test_seed_always_gives_the_same_scene(scenes, seed, moment, points, metres, labels):
    """Update the expected values after intended changes of the scenes."""
    scan = simulate_scan(seed, moment, TINY, scenes)
    assert len(scan.frame) == points
    assert np.abs(scan.frame.xyz, dtype=float).sum() == pytest.approx(metres, rel=1e-6)
    assert np.abs(scan.truth.boxes).sum() == pytest.approx(labels, rel=1e-9)


def test_trajectory_derivatives_are_exact():
    """Heading, velocity and yaw rate are derivatives of the position."""
    h = 1e-4
    for seed in range(20):
        way = draw_trajectory(np.random.default_rng(seed), 0.7)
        for t in (0.0, 3.3, 19.0):
            before, now, after = (way.evaluate(t + d) for d in (-h, 0.0, h))
            assert np.allclose(np.subtract(after[:2], before[:2]) / (2 * h), now.velocity, atol=1e-6)
            assert (after.heading - before.heading) / (2 * h) == pytest.approx(now.yaw_rate, abs=1e-6)
            assert abs(now.heading) < 0.71 and np.hypot(*now.velocity) < 1.5 / np.cos(0.7)
            assert np.allclose(np.tan(now.heading) * now.velocity[0], now.velocity[1])
    assert way.sample(20.0, 0.1).shape == (201, 3)
    assert Trajectory().evaluate(7.0) == (0.0, 0.0, 0.0, (0.0, 0.0), 0.0)


@pytest.mark.parametrize("scene, kind", ROBOTS)
def test_actors_never_touch_robot_or_each_other(scene, kind):
    simulated = make_cached_scene(scene, kind)
    props = [a for a in simulated.actors if not a.obj.label]
    fixed = make_flat_boxes(np.array([a.footprint for a in props]), 0.0)
    for t in np.linspace(0.0, simulated.seconds, 9):
        moment, pose = simulated.compute_state(t, 0.6), simulated.compute_sensor_pose(t, 0.6)
        robot = np.array([[0.0, 0, 0, 1.4 * ROBOT_RADIUS_M, 1.4 * ROBOT_RADIUS_M, 1, 0]])
        boxes = np.concatenate([robot, moment.boxes * [1, 1, 0, 1, 1, 1, 1]])
        assert not {0} & set(find_overlaps(boxes, 1)[:, 0].tolist())
        for i, j in find_overlaps(boxes, len(boxes)):
            assert {moment.class_ids[i - 1], moment.class_ids[j - 1]} == {SITTING}
        footprints = fixed - [*pose[:2, 3], 0, 0, 0, 0, 0]
        assert not len(find_overlaps(np.concatenate([robot, footprints]), 1))
    assert any(a.obj.label in ("Pedestrian", "Person_sitting") for a in simulated.actors)


@pytest.mark.parametrize("gap", [0.0, 0.6])
def test_person_moves_up_to_the_next_actor(gap):
    actors, wall = ActorSet(20.0), furniture.make_wall(np.random.default_rng(0), 8.0)
    actors.admit(Actor(make_prop(wall), 0.0, 5.0))
    person = Actor(make_pedestrian(np.random.default_rng(0), 0.0), 0.0, 2.0)
    assert actors.admit_next_to_other(person, np.pi / 2, 4.0, gap)
    person, wall = actors.actors[1], actors.actors[0].footprint
    free = wall[Y] - wall[WIDTH] - person.footprint[Y] - person.footprint[WIDTH]
    assert gap <= free < gap + 0.11 and person.x == pytest.approx(0.0)
    assert not actors.admit_next_to_other(person, np.pi / 2, 4.0, gap)  # the place is taken
    assert not actors.admit_next_to_other(replace(person, y=2.0), -np.pi / 2, 4.0, gap)  # nothing is there
    assert len(actors.actors) == 2


def test_many_people_stand_next_to_other_objects():
    near = total = 0
    for scene, kind in ROBOTS:
        actors = make_cached_scene(scene, kind).actors
        fixed = np.array([a.footprint for a in actors if a.speed == 0.0 and a.obj.label != "Pedestrian"])[:-1]
        for person in [a for a in actors if a.obj.label == "Pedestrian"]:
            total += 1
            near += person.speed == 0.0 and any(footprints_touch(person.footprint, f, 0.0, 1.0) for f in fixed)
    assert near > 0.35 * total > 10


@pytest.mark.parametrize("scene, kind", ROBOTS)
def test_points_and_boxes_agree_with_the_scene(scene, kind):
    """For any heading and yaw rate, the ground agrees with the world and points of labelled objects are in their
    boxes."""
    simulated = make_cached_scene(scene, kind)
    simulated = replace(simulated, ground=simulated.ground._replace(tuft_height=0.0, litter_height=0.0))
    for t in (0.0, 7.3):
        moment, pose = simulated.compute_state(t, 0.6), simulated.compute_sensor_pose(t, 0.6)
        hits = cast_rays(moment.solids, simulated.ground, moment.position, EXACT, moment.motion, 1, moment.heading)
        got = make_returns(hits, EXACT, moment.motion, np.random.default_rng(0))
        world = transform_points(got.xyz.astype(float), pose)
        ground = np.isin(got.semantic, GROUND) & (got.owner == 0)
        error = world[ground, 2] - compute_ground_height(simulated.ground, *world[ground, :2].T)
        # At a kerb, the height may be that of either side.
        assert ground.sum() > 100 and (np.abs(error) < 2e-3).mean() > 0.97
        assert np.abs(error).max() <= simulated.ground.curb_height + 2e-3
        boxes = moment.boxes.copy()
        boxes[:, :3] = transform_points(boxes[:, :3], pose)
        feet = compute_ground_height(simulated.ground, *boxes[:, :2].T)
        assert np.allclose(boxes[:, 2] - boxes[:, 5] / 2, feet)
        for box, track, speed in zip(moment.boxes, moment.track_ids, moment.speeds):
            own = got.xyz[(got.owner == track) & (got.semantic != 99)]
            far = np.hypot(*(own[:, :2] - box[:2]).T) if len(own) else np.zeros(1)
            assert far.max() < np.hypot(*box[3:5]) / 2 + 0.6 + speed / TINY.rate


def test_robot_scenes_have_labels_all_around_and_no_camera(tmp_path):
    frames = list(simulate_frames(3, 2, TINY, 1, Scenes(None, 3.0, "campus")))
    for number, frame in enumerate(frames):
        truth = frame.truth()
        scan = simulate_scan(3 + number, 0, TINY, Scenes(None, 3.0, "campus"))
        assert frame.camera() is None and frame.sensor_height == 0.6
        assert len(truth) == find_labelled(scan.truth).sum()
    assert any((frame.truth().boxes[:, 0] < 0).any() for frame in frames)
    assert next(simulate_frames(3, 1, TINY, 1)).camera() is not None


def test_mixture_alternates_between_kinds_of_scenes():
    mixture = Scenes(None, 1.0, "street,indoor")
    assert make_cached_scene("indoor", None, 3).kind == make_scene(3, None, 2.0, mixture.scene).kind
    assert make_scene(4, None, 1.0, mixture.scene).kind == make_scene(4).kind
    source = SimulatedScenes(3, 2, TINY, mixture)
    assert not mixture.camera and source.load_frame(0).camera() is None
    assert source.load_scene(0).height == 0.6 and source.cache_key(0) != SimulatedScenes(3, 2, TINY).cache_key(0)


@pytest.mark.parametrize("kind", SCENE_TYPES["indoor"].kinds)
def test_setup_measures_the_sensor_height_indoors(kind):
    sensor = replace(find_sensor("vlp-16", 0.6), azimuth_step=float(np.radians(0.8)))
    frames = [simulate_scan(7, i, sensor, Scenes(kind, 1.0, "indoor")).frame for i in (0, 1, 90, 91)]
    clouds = [
        from_array(to_point_array(frame), make_any_header(make_bag_message, frame.stamp_ns), make_bag_message)
        for frame in frames
    ]
    mount = measure_mount([read_scan(cloud) for cloud in clouds])
    assert mount.height == pytest.approx(0.6, abs=0.02)
    assert np.degrees([mount.roll, mount.pitch]) == pytest.approx([0.0, 0.0], abs=0.2)


@pytest.mark.parametrize("layout", ["mcap", "kitti-tracking", "semantickitti"])
def test_command_writes_every_layout_for_robots(layout, tmp_path):
    out = tmp_path / "drive"
    result = CliRunner().invoke(
        simulate,
        [
            "--scene",
            "campus",
            "--kind",
            "path",
            "--sensor",
            "generic:16,-15,15,2,10",
            "--mount-height",
            "0.6",
            "--format",
            layout,
            "--frames",
            "2",
            "--jobs",
            "1",
            "--out",
            str(out),
        ],
        catch_exceptions=False,
    )
    assert result.exit_code == 0
    first, second = open_recording(out)
    assert len(first.load()) > 500
    if layout != "kitti-tracking":  # this layout has no poses
        motion = np.linalg.inv(first.pose()) @ second.pose()
        assert 0.0 <= np.linalg.norm(motion[:3, 3]) < 0.3
    if layout == "semantickitti":
        classes = set(np.unique(first.point_truth().classes))
        assert classes & set(GROUND) and classes <= {
            1,
            10,
            11,
            13,
            15,
            16,
            18,
            20,
            30,
            31,
            50,
            51,
            70,
            71,
            80,
            81,
            99,
            *GROUND,
            *MOVING,
        }


@pytest.mark.parametrize(
    "scenes, message",
    [
        (Scenes(scene="moon"), "unknown scene 'moon': must be one of street, campus, indoor"),
        (Scenes("zone", 1.0, "campus"), "kind = 'zone' must be one of forecourt, square, path"),
        (Scenes("city", 1.0, "street,campus"), "kind = 'city' must be one of forecourt, square, path"),
        (Scenes(people=np.nan), "people = nan must be between 0 and 100"),
        (Scenes(people=1e25), "people = 1e.25 must be between 0 and 100"),
    ],
)
def test_unknown_scene_raises_input_error(scenes, message):
    with pytest.raises(InputError, match=message):
        next(simulate_frames(0, 1, TINY, 1, scenes))


def test_beam_wander_differs_between_scenes():
    sensor, elevations = replace(EXACT, wander=np.radians(2.0)), []
    for seed in range(3):
        scan = simulate_scan(seed, 0, sensor, Scenes(scene="campus"))
        lowest = scan.frame.xyz[scan.ring == sensor.rings - 1]
        elevations.append(np.degrees(np.median(np.arctan2(lowest[:, 2], np.hypot(*lowest[:, :2].T)))))
    assert np.diff(np.sort(elevations)).min() > 0.3 and np.ptp(elevations) < 2.0
