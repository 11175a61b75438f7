"""Simulated drives."""

from dataclasses import replace

import numpy as np
import pytest

from lidar_perception.geometry import box_corners, points_in_box
from lidar_perception.simulation import drive as drives
from lidar_perception.simulation.drive import label_scan, simulate_drive
from lidar_perception.simulation.raycast import cast_rays
from lidar_perception.simulation.returns import make_returns
from lidar_perception.simulation.scene import ALL_STREETS, CROWDED_ZONES
from lidar_perception.simulation.sensor import HDL64E, NO_MOTION
from lidar_perception.simulation.terrain import compute_ground_height
from lidar_perception.types import CLASSES, PEDESTRIAN

COARSE = replace(HDL64E, azimuth_step=float(np.radians(0.5)))
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("streets")]  # covered by other tests


def make_street(seed):
    return drives._make_cached_scene(seed, ALL_STREETS)


def scan(seed, t, sensor=COARSE):
    """Return scene, its state after t seconds, hits, and xyz and owner of the returns."""
    scene = make_street(seed)
    state = scene.compute_state(t, sensor.height)
    hits = cast_rays(state.solids, scene.ground, state.position, sensor)
    xyz, _, owner, *_ = make_returns(hits, sensor, NO_MOTION, np.random.default_rng(0))
    return scene, state, hits, xyz, owner


def test_same_seed_gives_same_bytes():
    def content(seed):
        return [
            (
                s.frame.xyz.tobytes(),
                s.frame.intensity.tobytes(),
                s.frame.stamp_ns,
                s.truth.boxes.tobytes(),
                s.truth.extras,
            )
            for s in simulate_drive(seed, 2, COARSE)
        ]

    first = content(0)
    assert first == content(0)
    assert all(a[0] != b[0] for a, b in zip(first, content(1)))


def test_frames_have_documented_properties():
    for i, scan in enumerate(simulate_drive(0, 3, COARSE)):
        frame, truth = scan.frame, scan.truth
        assert frame.xyz.dtype == frame.intensity.dtype == np.float32
        assert frame.xyz.shape == (len(frame.intensity), 3) and frame.xyz.flags.c_contiguous
        assert frame.frame_id == "velodyne"
        assert frame.stamp_ns == 1_700_000_000 * 10**9 + i * 10**8
        distance = np.linalg.norm(frame.xyz.astype(float), axis=1)
        assert distance.min() >= COARSE.min_range - 0.2 and distance.max() <= COARSE.max_range + 0.2
        assert frame.intensity.min() >= 0.0 and frame.intensity.max() <= 1.0
        assert np.hypot(*truth.boxes[:, :2].T).max() <= 80.0
        assert all(e["num_points"] > 0 and e["occluded"] in (0, 1, 2) and e["truncated"] == 0.0 for e in truth.extras)
        assert all(0.0 <= e["visible"] <= 1.0 for e in truth.extras)
        tracks = [e["track_id"] for e in truth.extras]
        assert len(set(tracks)) == len(tracks) and min(tracks) > 0


@pytest.mark.parametrize("t", [0.0, 3.9])
@pytest.mark.parametrize("seed", [0, 2])
def test_points_of_object_are_in_its_box(seed, t):
    _, state, hits, xyz, owner = scan(seed, t)
    semantic = make_returns(hits, COARSE, NO_MOTION, np.random.default_rng(0)).semantic
    for box, track, speed, kind in zip(state.boxes, state.track_ids, state.speeds, state.class_ids):
        on_object = (owner == track) & (semantic != 99)  # 99: carried objects
        # Hits at the edge of a beam are reported at its centre. Boxes are those at the stamp, while some points are
        # measured up to half a sweep later. Mirrors and umbrellas extend beyond the box.
        beam = (np.linalg.norm(box[:3]) + 10) * COARSE.divergence / 2 + 6 * COARSE.range_noise
        margin = beam + speed / COARSE.rate / 2 + (0.6 if kind == PEDESTRIAN else 0.2)
        assert points_in_box(xyz[on_object], box, margin=margin).all()
        is_outside = ~points_in_box(xyz[on_object], box, margin=beam + 0.05)
        assert speed > 2 or is_outside.sum() <= 0.4 * on_object.sum()
    assert set(np.unique(owner)) <= {0, *state.track_ids}
    truth = label_scan(state, hits, owner)
    assert [e["num_points"] for e in truth.extras] == [(owner == e["track_id"]).sum() for e in truth.extras]


@pytest.mark.parametrize("seed", range(3))
def test_boxes_stand_on_ground_without_overlap(seed):
    scene = make_street(seed)
    for t in (0.0, 2.0, 10.0, 19.9):
        state = scene.compute_state(t, 1.73)
        world = state.boxes[:, :3] + state.position
        ground = np.array([compute_ground_height(scene.ground, x, y) for x, y, _ in world])
        assert np.abs(world[:, 2] - state.boxes[:, 5] / 2 - ground).max() < 0.05
        # No footprint contains a corner or the centre of another one.
        flat = state.boxes * [1, 1, 0, 1, 1, 1, 1]
        corners_and_centres = np.concatenate([box_corners(flat)[:, :4] * [1, 1, 0], flat[:, None, :3]], axis=1)
        for i, box in enumerate(flat):
            assert not points_in_box(np.delete(corners_and_centres, i, axis=0).reshape(-1, 3), box).any()


def test_each_frame_has_visible_pedestrians():
    for scan in simulate_drive(33, 11, replace(COARSE, rate=2.5), CROWDED_ZONES):
        boxes = scan.truth.select_class(PEDESTRIAN)
        distance, bearing = np.hypot(boxes[:, 0], boxes[:, 1]), np.arctan2(boxes[:, 1], boxes[:, 0])
        in_view = (np.abs(bearing) < np.radians(40)) & (distance > 6) & (distance < 35)
        assert in_view.sum() >= 2


def test_scans_resemble_those_of_real_sensor():
    """KITTI scans have 109 000 to 127 000 points, and about 27 000 / range^2 on a fully visible pedestrian."""
    density, labels = [], set()
    for seed in (0, 33):
        scan = next(simulate_drive(seed, 1, scenes=CROWDED_ZONES))
        frame, truth = scan.frame, scan.truth
        assert 95_000 < len(frame) < 135_000
        assert 0.15 < frame.intensity.mean() < 0.4
        labels |= set(truth.labels)
        density += [
            e["num_points"] * (box[0] ** 2 + box[1] ** 2)
            for box, label, e in zip(truth.boxes, truth.labels, truth.extras)
            if label == "Pedestrian" and e["occluded"] == 0
        ]
    assert 12_000 < np.median(density) < 45_000
    assert {"Car", "Pedestrian", "Cyclist"} <= labels <= set(CLASSES)


@pytest.mark.parametrize(
    "arguments, message",
    [({"frames": 0}, "frames = 0"), ({"frames": 10_000}, "frames = 10000"), ({"seed": -1}, "seed = -1")],
)
def test_invalid_arguments_raise_at_the_call(arguments, message):
    with pytest.raises(ValueError, match=message) as error:
        simulate_drive(**arguments)
    assert "\n" not in str(error.value)
