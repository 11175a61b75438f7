"""The public interface, `import lidar_perception as lp`."""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from samples import make_scene, write_object_folder

import lidar_perception as lp
from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.ground.params import GroundParams, PatchworkParams, SensorPoseParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.types import InputError

NAMES = [
    "Detections",
    "PointCloud",
    "Tracker",
    "Tracks",
    "cluster",
    "evaluate",
    "find_candidates",
    "load_detector",
    "open_recording",
    "segment_ground",
    "simulate",
]
TINY = "generic:8,-10,10,2,10"


class NearestBox:
    """A detector that puts a box at the nearest point."""

    classes = ("Pedestrian",)

    def __call__(self, cloud):
        nearest = cloud.xyz[np.argmin(np.linalg.norm(cloud.xyz[:, :2], axis=1))]
        return lp.Detections.of([*nearest, 0.6, 0.6, 1.7, 0.0], scores=0.5)


def test_public_names_exist():
    assert sorted(lp.__all__) == NAMES and set(dir(lp)) == {*NAMES, "__version__"}
    assert all(getattr(lp, name).__doc__ for name in NAMES)
    with pytest.raises(AttributeError, match="'segment_grund'"):
        lp.segment_grund  # noqa: B018


def test_type_checking_imports_match_the_objects():
    tree = ast.parse(Path(lp.__file__).read_text())
    block = next(node for node in tree.body if ast.unparse(node).startswith("if TYPE_CHECKING"))
    imported = {
        alias.asname or alias.name: getattr(import_module(node.module), alias.name)
        for node in block.body
        for alias in node.names
    }
    assert imported == {name: getattr(lp, name) for name in NAMES}


def test_ground_and_clusters_equal_those_of_the_core():
    xyzi = make_scene(0)
    ground = lp.segment_ground(xyzi[:, :3], "patchwork", sensor_height=1.8, intensity=xyzi[:, 3], max_range=60)
    params = GroundParams("patchwork", SensorPoseParams(1.8), patchwork=PatchworkParams(max_range=60.0))
    np.testing.assert_array_equal(ground, segment_ground(xyzi, params))
    ids = lp.cluster(xyzi, ground=ground)
    assert ids.dtype == np.int32 and ids.max() > 0 and not ids[ground].any()
    np.testing.assert_array_equal(ids, cluster_obstacles(xyzi, ground))
    everything = lp.cluster(xyzi[:, :3], "euclidean", min_size=5)
    assert everything.shape == (len(xyzi),) and everything[ground].any()


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda xyz: lp.segment_ground(xyz, "patchwerk"), "did you mean 'patchwork'"),
        (lambda xyz: lp.segment_ground(xyz, max_hight=1.0), "did you mean 'max_height'"),
        (lambda xyz: lp.segment_ground(xyz, sensor_height=-1.0), "height = -1.0 is outside"),
        (lambda xyz: lp.segment_ground(xyz[:, :2]), "expected \\(N, 3\\)"),
        (lambda xyz: lp.segment_ground(lp.PointCloud(xyz), intensity=xyz[:, 0]), "already has an intensity"),
        (lambda xyz: lp.PointCloud.of(lp.PointCloud(xyz), xyz[:, 0]), "already has an intensity"),
        (lambda xyz: lp.cluster(xyz, "dbscam"), "did you mean 'dbscan'"),
        (lambda xyz: lp.cluster(xyz, min_sample=3), "did you mean 'min_samples'"),
        (lambda xyz: lp.cluster(xyz, ground=[True]), "ground has 1 values"),
        (lambda xyz: lp.find_candidates(xyz, settings={"stm.treshold": 0.5}), "stm.threshold"),
        (lambda xyz: lp.load_detector("fusd"), "did you mean 'fused'"),
        (lambda xyz: lp.simulate(0), "frames = 0"),
        (lambda xyz: lp.simulate(scene="stret"), "did you mean 'street'"),
        (lambda xyz: lp.simulate(sensor="vpl-16"), "vlp-16"),
        (lambda xyz: lp.evaluate(NearestBox, lp.simulate(1)), "give an instance"),
        (lambda xyz: lp.evaluate(NearestBox(), "nowhere"), "nowhere does not exist"),
    ],
)
def test_error_names_the_bad_argument_in_one_line(call, words):
    with pytest.raises(InputError, match=words) as error:
        call(np.ones((4, 3), np.float32))
    assert "\n" not in str(error.value)


def test_candidates_include_the_clicked_pedestrian():
    xyz = make_scene(1)[:, :3]
    automatic = lp.find_candidates(xyz)
    assert set(automatic.class_ids.tolist()) <= {3, 4} or len(automatic) == 0
    ground = lp.segment_ground(xyz)
    ids = lp.cluster(xyz, ground=ground)
    point = xyz[ids > 0][0]
    clicked = lp.find_candidates(
        xyz,
        click=point,
        ground=ground,
        cluster_ids=ids,
        settings={"confidence.threshold": 0.0, "height.tolerance": 5.0},
    )
    assert isinstance(clicked, lp.Detections) and len(clicked) >= len(automatic)


def test_evaluate_accepts_own_detector_and_simulated_frames():
    drive = lp.simulate(2, seed=3, sensor=TINY)
    frames = list(drive)
    assert [frame.name for frame in frames] == ["0000/000000", "0000/000001"]
    assert len(drive.frames[:1]) == 1 and isinstance(frames[0].load(), lp.PointCloud)
    result = lp.evaluate(NearestBox(), drive, intervals=5)
    assert result["frames"] == 2 and result["skipped"] == [] and "Car" in result["intervals"]
    assert lp.evaluate(NearestBox(), drive, limit=1)["frames"] == 1


def test_evaluate_opens_names_and_paths(tmp_path):
    folder = write_object_folder(tmp_path / "kitti")
    result = lp.evaluate(f"{__name__}:NearestBox", folder)
    assert result["frames"] == len(lp.open_recording(folder))


def test_evaluate_rejects_recording_without_labels(tmp_path):
    np.save(tmp_path / "cloud.npy", make_scene(0))
    with pytest.raises(InputError, match="labelled boxes"):
        lp.evaluate(NearestBox(), tmp_path / "cloud.npy")


def test_detections_accept_class_names():
    boxes = np.zeros((2, 7))
    assert lp.Detections.of(boxes, "car").labels == ["Car", "Car"]
    assert lp.Detections.of(boxes, ["Cyclist", "Pedestrian"]).labels == ["Cyclist", "Pedestrian"]
    with pytest.raises(InputError, match="did you mean 'Pedestrian'"):
        lp.Detections.of(boxes, "Pedestrain")


def test_tracker_keeps_ids_of_moving_detections():
    tracker, detections = lp.Tracker(), lp.Detections.of([5, 0, 0, 4, 2, 1.5, 0], 0, 0.9)
    for i in range(5):
        tracks = tracker(detections, i * 10**8 + 1)
    assert isinstance(tracks, lp.Tracks) and len(tracks.ids) == 1


def test_loaded_detector_returns_detections():
    detector = lp.load_detector(f"{__name__}:NearestBox", min_score=0.4)
    found = detector(make_scene(0))
    assert isinstance(found, DetectionResult) and len(found.detections) == 1
    assert len(lp.load_detector(f"{__name__}:NearestBox", min_score=0.6)(make_scene(0)).detections) == 0
