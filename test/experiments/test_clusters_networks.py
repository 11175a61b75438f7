"""Paper C's experiment with networks: detections, modified clouds, drives, and tables."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from pointnet_samples import make_random_network, make_small_config

from experiments.__main__ import cli
from experiments.clusters import detection_tables, drives, networks
from experiments.clusters.detection import Change, change_cloud, open_network
from experiments.clusters.drives import (
    add_velocities,
    compute_scores,
    from_columns,
    list_drive,
    simulate_key_frames,
    to_columns,
)
from experiments.clusters.experiment import CLUSTERS
from experiments.clusters.experiment import SHIPPED as SHIPPED_EXPERIMENT
from experiments.clusters.networks import COMPARED, NETWORKS, SHIPPED, choose_networks
from experiments.framework.trained_models import Model, TrainedModel
from lidar_perception.classes import CAR
from lidar_perception.data.frame import Frame
from lidar_perception.data.nuscenes.boxes import GlobalBoxes
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.pointnet import config as config_module
from lidar_perception.simulation import drive
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.tracking.tracker import Tracker
from lidar_perception.training.params import PointNetTraining
from lidar_perception.types import Detections

pytestmark = pytest.mark.usefixtures("one_thread", "streets")
SENSOR = "generic:16,-20,5,2,10"


@pytest.fixture(scope="module")
def coarse_drives():
    """Simulated drives of three scans of a sensor with few points."""
    with pytest.MonkeyPatch.context() as patch:
        sensor, simulate = find_sensor(SENSOR), drive.simulate_drive
        patch.setattr(drives, "simulate_drive", lambda seed, scans: simulate(seed, scans, sensor))
        patch.setattr(drives, "SCANS", 3)
        patch.setattr(drives, "SIMULATED_DRIVES", 1)
        for module in drives, detection_tables:
            patch.setattr(module, "REPLICATES", 5)
        yield


@pytest.fixture(scope="module")
def random_models(tmp_path_factory):
    """Networks with random weights in place of trained ones."""
    folder, found = tmp_path_factory.mktemp("models"), {}
    for seed, name in ((0, "improved"), (1, "improved"), (0, "base"), (0, "farthest")):
        config = make_small_config(name)
        path = folder / f"{name}{seed}.safetensors"
        save_checkpoint(path, make_random_network(config, seed), Header(config))
        model = Model(networks.name_model(name, seed), PointNetTraining())
        found[model.name] = TrainedModel(model, path, 2, 1.5, 2, 4, 1000)
    return found


@pytest.fixture(scope="module")
def frames():
    scans = [drive.simulate_scan(70 + i, 0, find_sensor(SENSOR)) for i in range(2)]
    return [Frame.of(f"scan {i}", scan.frame, scan.truth) for i, scan in enumerate(scans)]


def test_report_is_complete_with_and_without_records(coarse_drives, random_models, frames):
    experiment = CLUSTERS.with_models(random_models)
    records = [experiment.measure(frames, i) for i in range(2)]
    assert json.loads(json.dumps(records, allow_nan=False)) == records
    assert [*records[0]["found"]] == [*random_models, *SHIPPED]
    assert [*records[0]["changed"]["10 %"]] == ["improved, seed 0", *SHIPPED]
    assert len(records[0]["drive"]) == 3 and records[1]["drive"] is None
    for some in ([], [{"frame": "x", "skipped": "why"}], records):
        tables = {table.name: table for section in experiment.make_sections(some) for table in section.tables}
        assert {
            "table_2",
            "table_3",
            "table_4",
            "table_5",
            "table_6",
            "table_7",
            "table_8",
            "figure_10",
            "readings",
        } <= set(tables)
        for table in tables.values():
            assert all(len(row) == len(table.header) for row in table.rows), table.name
    names = [row[0] for row in tables["table_5"].rows]
    assert names == ["base", "improved"] and tables["table_5"].rows[1][-1] == "2"
    assert [row[0] for row in tables["table_4"].rows] == ["0.1, 0.2, 0.4 m"]
    without, tracked = tables["table_7"].rows[:2]
    assert without[6].value == 1.0 != tracked[6].value and tracked[2].paper is not None


def test_shipped_detectors_need_no_training(coarse_drives, frames):
    records = [SHIPPED_EXPERIMENT.measure(frames, i) for i in range(2)]
    assert [*records[0]["found"]] == [*records[0]["changed"]["10 %"]] == [*SHIPPED]
    sections = SHIPPED_EXPERIMENT.make_sections(records)
    tables = {table.name: table for section in sections for table in section.tables}
    assert {*tables} == {"table_6", "figure_10", "table_7", "table_8"}
    assert {row[0] for row in tables["table_8"].rows} == {*SHIPPED}
    assert all(row[5].value > 0 for row in tables["table_8"].rows)  # milliseconds


def test_experiment_without_training_runs_on_simulated_scans(tmp_path, coarse_drives):
    command = ["reproduce", "clusters-shipped", "sim", "--limit", "1", "--jobs", "1", "--out"]
    result = CliRunner().invoke(cli, [*command, str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["measured"] == 1 and report["about"]["data"].startswith("simulated scans")
    (tmp_path / "names.txt").write_text("scene 1")
    result = CliRunner().invoke(cli, [*command, str(tmp_path / "other"), "--split", str(tmp_path / "names.txt")])
    assert "--split is for recordings" in str(result.exception)


def test_shipped_detectors_have_their_gamma_and_range():
    plain, merged, pillars = (open_network(source, 1.5, "around") for source in SHIPPED.values())
    assert plain.params.clustering.euclidean.gamma == 0.0 and merged.params.clustering.euclidean.gamma == 0.8
    assert {d.params.ground.sensor_pose.height for d in (plain, merged, pillars)} == {1.5}
    assert {d.range for d in (plain, merged, pillars)} == {"around"}
    assert open_network(SHIPPED["PointPillars V0, shipped"], 1.5).range == "ahead"


def test_every_network_of_the_tables_can_be_trained():
    models = choose_networks(PointNetTraining(), 3)
    assert len({model.name for model in models}) == len(models) == len(NETWORKS) == 16
    assert {model.params.network for model in models} <= set(config_module.NETWORKS)
    assert {model.params.seed for model in models} == {3}
    assert {*COMPARED} - {*SHIPPED} <= {model.params.network for model in models if model.required}


def test_tiny_budget_runs_end_to_end(tmp_path, coarse_drives, monkeypatch):
    monkeypatch.setattr(networks, "NETWORKS", ("improved",))
    result = CliRunner().invoke(
        cli,
        [
            "reproduce",
            "clusters",
            "sim",
            "--out",
            str(tmp_path / "out"),
            "--limit",
            "1",
            "--jobs",
            "1",
            "--seeds",
            "1",
            *(
                word
                for value in (
                    f"sensor={SENSOR}",
                    "data.scans=2",
                    "data.val_scans=1",
                    "steps=2",
                    "batch=1",
                    "data.people=1",
                )
                for word in ("--set", value)
            ),
        ],
    )
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report["measured"] == 1 and "Table 8" in (tmp_path / "out/report.md").read_text()


def test_thinning_and_noise_are_reproducible(frames):
    cloud = frames[0].load()
    half, second_half = (change_cloud(cloud, Change(fraction=0.5), "a") for _ in range(2))
    assert len(half) == pytest.approx(len(cloud) / 2, rel=0.2)
    np.testing.assert_array_equal(half.xyz, second_half.xyz)
    noisy = change_cloud(cloud, Change(noise=0.05), "a")
    shift = np.linalg.norm(noisy.xyz, axis=1) - np.linalg.norm(cloud.xyz, axis=1)
    assert shift.std() == pytest.approx(0.05, rel=0.1)
    across = np.cross(noisy.xyz, cloud.xyz) / (np.linalg.norm(cloud.xyz, axis=1) ** 2)[:, None]
    assert np.abs(across).max() < 1e-4 and change_cloud(cloud, Change(), "a") is cloud


def test_simulated_labels_have_velocities(coarse_drives):
    frames = simulate_key_frames(drives.FIRST_DRIVE)
    labels = [frame.native.labels() for frame in frames]
    speeds = np.linalg.norm(labels[1].boxes.velocities, axis=1)
    assert (speeds[np.isfinite(speeds)] > 2).any() and (speeds < 0.01).any()
    later_centres = {i: centre for i, centre in zip(labels[2].instances, labels[2].boxes.centres)}
    seconds = 1e-9 * (frames[2].stamp_ns - frames[0].stamp_ns)
    for i, centre, velocity in zip(labels[0].instances, labels[0].boxes.centres, labels[1].boxes.velocities):
        if i in later_centres and i == labels[1].instances[list(labels[0].instances).index(i)]:
            np.testing.assert_allclose((later_centres[i] - centre)[:2], velocity * seconds, atol=0.3)


def test_drive_starts_at_the_first_frame_of_a_scene(coarse_drives, frames):
    assert len(list_drive(frames, 0)) == 3 and list_drive(frames, 1) == ()
    key_frames = [
        replace(frame, native=simulate_key_frames(5)[0].native, sequence=name)
        for frame, name in zip([*frames, *frames], "aabb")
    ]
    assert [len(list_drive(key_frames, i)) for i in range(4)] == [2, 0, 2, 0]


def test_boxes_get_the_velocities_of_their_tracks():
    tracker, pose = Tracker(), np.eye(4)
    pose[:2, :2] = [[0, -1], [1, 0]]  # the sensor's x axis is the global y axis
    for i in range(12):
        box = [[5 + 0.8 * i, 2, -0.9, 4.2, 1.7, 1.5, 0]]
        found = Detections.of(box, [CAR], [0.9])
        tracks = tracker(found, 10**9 + i * 10**8, pose)
    boxes = GlobalBoxes.of([[-2, 5 + 0.8 * 11, 0], [30, 30, 0]], np.ones((2, 3)), np.eye(4)[:2], 0)
    boxes_with_velocities = add_velocities(boxes, tracks, pose)
    assert boxes_with_velocities.velocities[0] == pytest.approx([0, 8], abs=1.0)
    assert boxes_with_velocities.velocities[1].tolist() == [0, 0]


def test_boxes_survive_json_and_perfect_ones_have_a_score():
    truth = GlobalBoxes.of(
        [[5, 0, 0], [9, 3, 0]], np.ones((2, 3)), np.eye(4)[[0, 0]], 0, velocities=[[1, 0], [np.nan, np.nan]]
    )
    found = replace(truth, scores=np.array([0.9, 0.8]))
    back = from_columns(json.loads(json.dumps(to_columns(found), allow_nan=False)))
    assert compute_scores([truth], [back])[1] > 0  # two of three classes are missing
    for name in ("centres", "class_ids", "velocities", "scores"):
        np.testing.assert_array_equal(getattr(back, name), getattr(found, name))
    assert np.isnan(compute_scores([], [])).all()
    assert len(from_columns(to_columns(GlobalBoxes.none()))) == 0
