"""Properties of the comparison of simulated with real scans."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from io import StringIO

import numpy as np
import pytest
from click.testing import CliRunner
from rich.console import Console
from samples import CALIBRATION, make_calibration_text, make_scene, make_walker_label, write_file, write_object_folder

from experiments.realism import command
from experiments.realism.compare import (
    MAX_SCANS,
    MIN_SAMPLES,
    compare_scans,
    compute_factor,
    compute_median_interval,
    compute_ratio,
    measure_scans,
    select_frames,
)
from experiments.realism.report import print_realism
from experiments.realism.scan_statistics import (
    CLASSES,
    CURVES,
    compute_object_rows,
    compute_scan_rows,
    compute_square_degrees,
    is_full_scan,
)
from lidar_perception.candidates.configurations import PAPER
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.types import CLASSES as KITTI_CLASSES
from lidar_perception.types import SENSOR_HEIGHT, GroundTruth, InputError, PointCloud

SCANS = 6
FEET = -1.7
SIZES = {"Car": (3.9, 1.6, 1.5), "Pedestrian": (0.8, 0.6, 1.75), "Cyclist": (1.8, 0.6, 1.7)}
PLACES = {
    "Car": ((15.0, 6.0), (25.0, 9.0), (38.0, 2.0)),
    "Pedestrian": ((13.0, -3.0), (24.0, -6.0)),
    "Cyclist": ((17.0, -7.0), (27.0, 1.0)),
}
COUNTS = (
    "scan points",
    "points",
    "elevation",
    *(f"{name} {what}" for name in CLASSES for what in ("points", "points of all", "density")),
)
EXTENTS = [f"{name} {what}" for name in CLASSES for what in ("height", "length", "width")]
FACES = [name for name in CURVES if name.startswith("Car from")]  # in these scenes each car shows more than one side
LIGHT = [name for name in CURVES if "intensity" in name]


def make_scan(seed: int, points: int = 500) -> Frame:
    """Return a scan of a street, all around the sensor, with objects that are filled with points."""
    rng = np.random.default_rng(seed)
    reach, turn = rng.uniform(3, 70, 12000), rng.uniform(-np.pi, np.pi, 12000)
    reach[:3000] = rng.uniform(3, 9, 3000)  # dense enough for every ground cell
    parts = [np.column_stack([reach * np.cos(turn), reach * np.sin(turn), rng.normal(FEET, 0.01, 12000)])]
    boxes, ids = [], []
    for name, places in PLACES.items():
        for x, y in places:
            size = np.array(SIZES[name])
            centre = np.array([x, y, FEET + size[2] / 2]) + rng.uniform(-0.5, 0.5, 3) * [1, 1, 0]
            parts.append(centre + rng.uniform(-0.5, 0.5, (points, 3)) * size)
            boxes.append([*centre, *size, 0.0])
            ids.append(KITTI_CLASSES.index(name))
    xyz = np.concatenate(parts).astype(np.float32)
    intensity = rng.beta(2, 4, len(xyz)).round(2).astype(np.float32)
    extras = [{"occluded": 0, "truncated": 0.0} for _ in boxes]
    return Frame.of(str(seed), PointCloud(xyz, intensity), GroundTruth.of(boxes, ids, extras), CALIBRATION)


def replace_scan(frame: Frame, scan: PointCloud) -> Frame:
    """Return the frame with other points."""
    return Frame.of(frame.name, scan, frame.truth(), frame.calibration())


def compute_rows(frame: Frame) -> dict:
    """Return the rows of the frame's objects."""
    return compute_object_rows(frame.load(), frame.truth(), frame.camera())


def change_scans(change, count: int = SCANS) -> list[Frame]:
    """Return the scans of the street with a change applied to every frame."""
    return [
        replace_scan(r, change(r.load(), np.random.default_rng(100 + i)))
        for i, r in enumerate(map(make_scan, range(count)))
    ]


@cache
def measure_street():
    return measure_scans(map(make_scan, range(SCANS)), PAPER)


def list_judged_bins(content: dict, names=CURVES) -> list[dict]:
    return [b for name in names for b in content["curves"][name]["bins"] if b["within"] is not None]


def test_recording_compared_with_itself_agrees():
    content = compare_scans(measure_street(), measure_street())
    assert content["within"] == content["judged"] == len(list_judged_bins(content)) > 100
    assert all(b["ratio"] == 1.0 and compute_factor(b) == 1.0 for b in list_judged_bins(content))
    assert all(content["curves"][name]["judged"] for name in CURVES if name not in FACES)


def test_ground_is_found_below_a_low_sensor():
    up = np.array([0, 0, SENSOR_HEIGHT - 0.7], np.float32)
    lower = []
    for frame in map(make_scan, range(SCANS)):
        scan = frame.load()
        lower.append(Frame.of(frame.name, replace(scan, xyz=scan.xyz + up), sensor_height=0.7))
    measurement = measure_scans(lower, PAPER)
    for curve in ("clusters", "person clusters"):
        np.testing.assert_array_equal(measurement.rows[curve], measure_street().rows[curve])


def test_removing_points_changes_counts_and_not_sizes():
    def half(frame, rng):
        return frame.take(np.flatnonzero(rng.random(len(frame)) < 0.5))

    content = compare_scans(measure_street(), measure_scans(change_scans(half), PAPER))
    for name in COUNTS:
        bins = [b for b in list_judged_bins(content, [name]) if b["real"]["median"] >= 100]
        assert all(b["ratio"] == pytest.approx(0.5, abs=0.1) for b in bins), name
        assert content["curves"][name]["share"] < 0.5, name
    assert all(b["within"] for b in list_judged_bins(content, EXTENTS))
    assert all(b["within"] for b in list_judged_bins(content, LIGHT))


def test_halving_the_intensity_changes_intensities_only():
    content = compare_scans(
        measure_street(),
        measure_scans(change_scans(lambda frame, rng: replace(frame, intensity=frame.intensity * 0.5)), PAPER),
    )
    for name, curve in content["curves"].items():
        if name not in LIGHT:
            assert all(b["ratio"] in (1.0, None) for b in curve["bins"]), name
        elif curve["judged"]:
            assert all(b["ratio"] == pytest.approx(0.5, abs=0.03) for b in curve["bins"]), name


def test_order_of_points_does_not_matter():
    content = compare_scans(
        measure_street(), measure_scans(change_scans(lambda frame, rng: frame.take(rng.permutation(len(frame)))), PAPER)
    )
    for name, curve in content["curves"].items():
        for b in curve["bins"]:
            assert b["real"] == b["simulated"], name


def test_counts_add_up():
    one = make_scan(0)
    rows = {name: row[0] for name, row in compute_scan_rows(one.load()).items()}
    assert rows["points"].sum() == rows["scan points"][0] == len(one.load())
    assert ((rows["ground share"] >= 0) & (rows["ground share"] <= 1) | np.isnan(rows["ground share"])).all()
    assert (rows["person clusters"] <= rows["clusters"]).all()
    for name in LIGHT:
        row = {**rows, **{k: v[0] for k, v in compute_rows(one).items()}}[name]
        assert (np.diff(row) >= 0).all()


def test_bins_of_few_real_samples_are_excluded():
    content = compare_scans(measure_scans(map(make_scan, range(MIN_SAMPLES - 1)), PAPER), measure_street())
    assert all(content["curves"][name]["judged"] == 0 for name in (*COUNTS, *EXTENTS))
    for name, curve in content["curves"].items():
        for b in curve["bins"]:
            assert (b["within"] is None) == (b["real"]["n"] < MIN_SAMPLES), (name, b)


def test_missing_simulated_samples_count_as_a_difference():
    content = compare_scans(measure_street(), measure_scans([], PAPER))
    assert content["within"] == 0
    assert content["judged"] == compare_scans(measure_street(), measure_street())["judged"]


def test_empty_scans_are_excluded():
    none = PointCloud(np.zeros((0, 3), np.float32))
    empty = Frame.of("0", none, GroundTruth.of([], []), CALIBRATION)
    for scans in ([], [empty], [Frame.of("0", none, None, CALIBRATION)]):
        measurement = measure_scans(scans, PAPER)
        content = compare_scans(measurement, measurement)
        assert (content["judged"], content["share"]) == (0, None)
        print_realism(content, Console(file=StringIO()))


def test_scans_without_intensity_have_all_other_curves():
    bare = [Frame.of(r.name, replace(r.load(), intensity=None), r.truth()) for r in map(make_scan, range(2))]
    measurement = measure_scans(bare, replace(PAPER, view=replace(PAPER.view, enabled=False)))
    assert all(
        (len(rows) == 0) == (name in LIGHT)
        for name, rows in measurement.rows.items()
        if not name.startswith(("stage", "final")) and name not in FACES
    )


def test_cropped_scan_contributes_only_its_objects():
    whole = make_scan(0)
    in_view = np.flatnonzero(whole.camera().in_view(whole.load().xyz))
    cropped = replace_scan(whole, whole.load().take(in_view))
    assert is_full_scan(whole.load()) and not is_full_scan(cropped.load())
    measurement = measure_scans([cropped], PAPER)
    assert (measurement.scans, measurement.full_scans) == (1, 0)
    assert all(not measurement.rows[name] for name in ("points", "clusters", "ground intensity"))
    expected = compute_rows(whole)
    assert all(np.array_equal(rows, expected[name], equal_nan=True) for name, rows in compute_rows(cropped).items())


def test_objects_at_the_image_border_are_excluded():
    one = make_scan(0)
    border = one.truth().boxes[:1].copy()
    while one.camera().in_view(border[:, :3]).all():
        border[0, 1] += 0.1
    border[0, 1] -= 0.2  # the centre is in view, but half of the box is not
    assert compute_object_rows(one.load(), GroundTruth.of(border, [0]), one.camera()) == {}


@pytest.mark.parametrize("level", [1, 2, 3])
def test_occluded_objects_contribute_only_points_and_intensity(level):
    one = make_scan(0)
    truth = one.truth()
    truth = replace(truth, extras=tuple({"occluded": level} for _ in truth.extras))
    found = set(compute_object_rows(one.load(), truth, one.camera()))
    assert found == {name for name in compute_rows(one) if name.endswith("points of all") or "intensity" in name}


@pytest.mark.parametrize(
    "face, sensor",
    [("behind", (-15, 1, 0)), ("the front", (12, -2, 1)), ("the side", (1, 14, 0)), ("the side", (-2, -9, 0))],
)
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_depth_of_points_behind_each_car_side_is_measured(face, sensor, yaw):
    size, depth = np.array([4.0, 1.8, 1.5]), 0.07
    axis, half = int(face == "the side"), size[int(face == "the side")] / 2
    own = np.random.default_rng(2).uniform(-0.5, 0.5, (60, 3)) * size
    own[:, axis] = np.sign(sensor[axis]) * (half - depth)
    cos, sin = np.cos(yaw), np.sin(yaw)
    turn = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    centre = -turn @ np.array(sensor, float)
    box = GroundTruth.of(np.array([[*centre, *size, yaw]]), [0])

    def found(points, truth=box):
        scan = PointCloud((centre + points @ turn.T).astype(np.float32), None)
        return {
            name: row for name, row in compute_object_rows(scan, truth, None).items() if name.startswith("Car from")
        }

    assert set(found(own)) == {f"Car from {face}"}
    assert found(own)[f"Car from {face}"][0] == pytest.approx([depth] * 3, abs=1e-4)
    assert found(own[:5]) == {} == found(own, replace(box, extras=({"occluded": 1},)))


def test_solid_angle_of_a_box_follows_its_visible_size():
    upright = np.array([20.0, 0, 0, 0.5, 0.5, 1.7, 0])
    expected = np.degrees(0.5 / 20) * np.degrees(1.7 / 20)
    assert compute_square_degrees(upright) == pytest.approx(expected, rel=0.01)
    rotated_box = np.array([0, 20.0, 0, 0.5, 0.5, 1.7, np.pi / 2])
    assert compute_square_degrees(rotated_box) == pytest.approx(compute_square_degrees(upright))
    side, behind = (np.array([20.0, 0, 0, 4, 2, 1.5, yaw]) for yaw in (np.pi / 2, 0))
    assert compute_square_degrees(side) == pytest.approx(2 * compute_square_degrees(behind), rel=0.01)


def test_ratio_is_none_for_missing_values():
    assert compute_ratio(3.0, 2.0) == 1.5 and compute_ratio(0.0, 0.0) == 1.0
    for simulated, real in ((1.0, 0.0), (None, 1.0), (1.0, None)):
        assert compute_ratio(simulated, real) is None


def test_median_interval_covers_the_median():
    rng = np.random.default_rng(0)
    for count, least in ((5, 0.93), (27, 0.95), (200, 0.95)):
        limits = [compute_median_interval(rng.normal(size=count)) for _ in range(2000)]
        assert np.mean([low <= 0 <= high for low, high in limits]) > least - 0.02
    assert compute_median_interval(np.array([3.0])) == [3.0, 3.0]


def test_median_within_real_interval_is_plausible():
    def thin(shares):
        return measure_scans(
            [
                replace_scan(r, r.load().take(np.flatnonzero(np.random.default_rng(100).random(len(r.load())) < share)))
                for r, share in zip(map(make_scan, range(SCANS)), shares)
            ],
            PAPER,
        )

    content = compare_scans(thin(np.linspace(0.3, 1, SCANS)), thin([0.9] * SCANS))
    points = list_judged_bins(content, ["scan points", "Car points"])
    assert not any(b["within"] for b in points) and all(b["plausible"] for b in points)
    assert content["within"] < content["plausible"] <= content["judged"]
    assert all(b["plausible"] for b in list_judged_bins(content) if b["within"])


def test_comparison_survives_json_and_is_printed():
    content = compare_scans(measure_street(), measure_scans(map(make_scan, range(3)), PAPER))
    parsed = json.loads(json.dumps(content, allow_nan=False))
    assert parsed == content
    output = StringIO()
    print_realism(parsed, Console(file=output, width=100))
    assert f"{content['within']} of {content['judged']} bins" in output.getvalue()


def tracking_folder(root):
    write_file(root / "training/velodyne/0000/000003.bin", make_scene().tobytes())
    write_file(root / "training/calib/0000.txt", make_calibration_text())
    write_file(root / "training/label_02/0000.txt", f"3 7 {make_walker_label()}\n")
    return root


@pytest.mark.parametrize("make", [lambda root: write_object_folder(root, make_walker_label(), 1), tracking_folder])
def test_object_and_tracking_folders_are_read(tmp_path, make):
    measurement = measure_scans(select_frames(open_recording(make(tmp_path))), PAPER)
    assert measurement.objects == {"Car": 0, "Pedestrian": 1, "Cyclist": 0}
    assert (measurement.scans, measurement.full_scans, measurement.skipped) == (1, 1, [])


def test_folders_without_labels_are_rejected(tmp_path):
    write_object_folder(tmp_path)
    for label in tmp_path.rglob("label_2/*.txt"):
        label.unlink()
    with pytest.raises(InputError, match="no labels"):
        select_frames(open_recording(tmp_path))


def test_broken_scans_are_skipped_and_counted(tmp_path):
    scans = sorted(write_object_folder(tmp_path, make_walker_label(), 3).rglob("velodyne/*.bin"))
    write_file(scans[1], b"cut")
    measurement = measure_scans(select_frames(open_recording(tmp_path)), PAPER)
    assert measurement.scans == 2 and len(measurement.skipped) == 1
    assert compare_scans(measurement, measurement)["real"]["skipped"] == measurement.skipped
    for scan in scans:
        write_file(scan, b"cut")
    with pytest.raises(InputError, match=r"cannot read any of the 3 scans: .*000000.bin"):
        measure_scans(select_frames(open_recording(tmp_path)), PAPER)


def test_frames_of_large_folder_are_evenly_spaced(tmp_path):
    recording = open_recording(write_object_folder(tmp_path, make_walker_label(), 1))
    many = [replace(recording.frames[0], name=str(i)) for i in range(3 * MAX_SCANS)]
    selected_frames = select_frames(replace(recording, frames=many))
    numbers = [int(f.name) for f in selected_frames]
    assert len(numbers) == MAX_SCANS
    assert (numbers[0], numbers[-1]) == (0, len(many) - 1) and set(np.diff(numbers)) <= {3, 4}


def test_command_writes_json(tmp_path):
    root, out = write_object_folder(tmp_path / "kitti", make_walker_label(), 1), tmp_path / "made"
    result = CliRunner().invoke(
        command.realism, [str(root), "--frames", "1", "--json", str(out / "realism.json")], catch_exceptions=False
    )
    assert result.exit_code == 0, result.output
    content = json.loads((out / "realism.json").read_text())
    assert set(content["curves"]) == set(CURVES)
    assert content["real"]["scans"] == content["simulated"]["scans"] == 1


def test_command_simulates_the_given_sensor(tmp_path):
    root, found = write_object_folder(tmp_path / "kitti", make_walker_label(), 1), tmp_path / "realism.json"
    result = CliRunner().invoke(
        command.realism,
        [str(root), "--frames", "1", "--json", str(found), "--sensor", "generic:4,-12,0,2,10"],
        catch_exceptions=False,
    )
    assert result.exit_code == 0, result.output
    bins = json.loads(found.read_text())["curves"]["points"]["bins"]
    assert 100 < sum(b["simulated"]["median"] for b in bins) <= 4 * 180


def test_real_scans_compared_with_themselves_agree(data):
    scans = [r for r in open_recording(data / "kitti_object") if is_full_scan(r.load())][:2]
    first, second = (measure_scans(scans, PAPER) for _ in range(2))
    content = compare_scans(first, second)
    assert all(b["ratio"] in (1.0, None) for c in content["curves"].values() for b in c["bins"])
    assert first.full_scans == 2
