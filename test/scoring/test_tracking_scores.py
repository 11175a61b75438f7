"""HOTA, CLEAR MOT and AB3DMOT scores: invariants and comparison with slow implementations of the papers."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import tracking_reference as slow
from rich.console import Console

from lidar_perception.data.frame import Frame, Recording
from lidar_perception.data.kitti.labels import read_tracking_labels
from lidar_perception.data.kitti.results import write_tracking_results
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.scoring.run import fill_report
from lidar_perception.scoring.tracking.clear import ClearCounts, count_clear
from lidar_perception.scoring.tracking.hota import HotaCounts, count_hota
from lidar_perception.scoring.tracking.over_recall import score_over_recall
from lidar_perception.scoring.tracking.pairs import Pairs, drop_ignored, make_pairs, to_tracked_labels
from lidar_perception.scoring.tracking.report import TrackingReport, make_observation, measure_tracking
from lidar_perception.scoring.tracking.tables import print_tracking_report
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import CLASSES, Detections, GroundTruth, InputError, PointCloud

CAR, VAN = CLASSES.index("Car"), CLASSES.index("Van")


def random_sequences(seed: int) -> list[list[Pairs]]:
    """Return three sequences in which tracks follow labels, swap, fail, or have no label."""
    rng = np.random.default_rng(seed)
    sequences = []
    for _ in range(3):
        frames = []
        for _ in range(12):
            true = np.sort(rng.choice(5, rng.integers(0, 5), replace=False))
            tracks = np.sort(rng.choice(6, rng.integers(0, 5), replace=False)) + 10
            same = (tracks[None, :] - 10) == true[:, None]
            alike = rng.uniform(0, 1, same.shape) * np.where(same & (rng.uniform(size=same.shape) < 0.8), 1.0, 0.6)
            frames.append(
                Pairs(
                    true,
                    rng.uniform(size=len(true)) < 0.2,
                    tracks,
                    tracks / 16 + rng.uniform(0, 0.05, len(tracks)),
                    rng.uniform(size=len(tracks)) < 0.2,
                    alike,
                    np.clip(alike - 0.1, 0, 1),
                )
            )
        sequences.append(frames)
    return sequences


def to_plain_frames(sequences):
    return [
        [
            (
                list(zip(f.true_ids.tolist(), f.is_ignored.tolist())),
                list(zip(f.track_ids.tolist(), f.scores.tolist(), f.is_excused.tolist())),
                lambda i, j, f=f: float(f.similarity[i, j]),
                lambda i, j, f=f: float(f.overlap[i, j]),
            )
            for f in frames
        ]
        for frames in sequences
    ]


def count_sequences(sequences):
    hota, clear = HotaCounts(), ClearCounts()
    for frames in sequences:
        scored_frames = [drop_ignored(f) for f in frames]
        hota, clear = hota + count_hota(scored_frames), clear + count_clear(scored_frames)
    return hota.compute_scores(), clear


@pytest.mark.parametrize("seed", range(6))
def test_fast_scores_equal_a_slow_implementation(seed):
    sequences = random_sequences(seed)
    hota, clear = count_sequences(sequences)
    assert [hota[k] for k in ("HOTA", "DetA", "AssA")] == pytest.approx(
        slow.compute_hota(to_plain_frames(sequences)), abs=1e-12
    )
    assert (clear.tp, clear.fn, clear.fp, clear.switches, clear.fragments) == slow.compute_clear(
        to_plain_frames(sequences)
    )
    curve = score_over_recall(sequences)
    assert [curve[k] for k in ("sAMOTA", "AMOTA", "AMOTP")] == pytest.approx(
        slow.compute_over_recall(to_plain_frames(sequences)), abs=1e-12
    )


def make_drive(ids=(1, 2), frames=10, switch_at=None, kind=CAR):
    """Return frames (truth, tracks) of two perfectly tracked cars side by side."""
    result = []
    for i in range(frames):
        boxes = np.array([[10.0 + i, y, -1.0, 4.0, 1.8, 1.5, 0.0] for y in (-3.0, 3.0)])
        truth = GroundTruth.of(boxes, [kind] * 2, [{"track_id": k, "occluded": 0, "truncated": 0.0} for k in (7, 8)])
        names = ids[::-1] if switch_at is not None and i >= switch_at else ids
        result.append((truth, to_tracked_labels(np.array(names), Detections.of(boxes, CAR, 0.9))))
    return result


def score_drive(frames, order=None, calibration=None):
    report = TrackingReport()
    for i in order or range(len(frames)):
        report.update(make_observation("a", i, *frames[i], calibration))
    return report.compute()["classes"]["Car"]


def test_labels_as_tracks_score_one():
    score = score_drive(make_drive())
    for name in ("HOTA", "DetA", "AssA", "MOTA", "MOTP"):
        assert score[name] == pytest.approx(1.0, abs=1e-5)
    assert (score["switches"], score["fragments"], score["mostly_tracked"]) == (0, 0, 2)
    assert score["sAMOTA"] == pytest.approx(score["AMOTP"], abs=1e-5)


def test_swapped_ids_count_as_two_switches():
    score = score_drive(make_drive(switch_at=5))
    assert score["switches"] == 2 and score["DetA"] == pytest.approx(1.0)
    assert score["AssA"] == pytest.approx(1 / 3)  # each pair: 5 / (10 + 10 - 5)


def test_order_of_frames_does_not_matter():
    frames = make_drive(switch_at=4)
    assert score_drive(frames, order=[9, 3, 1, 0, 2, 8, 7, 4, 5, 6]) == score_drive(frames)


def test_unnamed_drives_of_a_bag_score_like_named_ones():
    """Track ids are counted separately in each drive."""

    def content(with_names):
        frames, found = [], {}
        for k in range(2):
            for i, (truth, _) in enumerate(make_drive()):
                scan = PointCloud(np.ones((1, 3), np.float32), None, k * 10**10 + i * 10**8)
                truth = GroundTruth.of(truth.boxes[:: 1 - 2 * k], truth.class_ids, truth.extras)
                found[scan.stamp_ns] = DetectionResult(Detections.of(truth.boxes, CAR, 0.9))
                frames.append(
                    Frame.of(
                        f"{k}/{i}", scan, truth, sequence=str(k) * with_names, index=i if with_names else len(frames)
                    )
                )
        recording, report = Recording("a", "", frames), TrackingReport()
        fill_report(
            report,
            recording,
            partial(measure_tracking, lambda: lambda scan: found[scan.stamp_ns], TrackingParams(), "none"),
        )
        return report.compute()

    assert content(False) == content(True)
    assert content(False)["sequences"] == 2 and content(False)["classes"]["Car"]["switches"] == 0


def test_frames_without_pose_are_counted_and_reported(capsys):
    poses = [np.eye(4), None, None]
    frames = [
        Frame.of(
            f"a/{i}",
            PointCloud(np.ones((1, 3), np.float32), None, 10**8 * (i + 1)),
            truth,
            sequence="a",
            index=i,
            pose=lambda i=i: poses[i],
        )
        for i, (truth, _) in enumerate(make_drive(frames=3))
    ]
    for ego, unknown in ("recording", 2), ("none", 0):
        report = TrackingReport()
        fill_report(
            report,
            Recording("a", "", frames),
            partial(measure_tracking, lambda: lambda scan: DetectionResult(Detections.none()), TrackingParams(), ego),
        )
        print_tracking_report({"ego": ego, **report.compute()}, Console(width=200))
        assert report.compute()["without_pose"] == unknown
        output = capsys.readouterr().out
        assert ("no pose: 2 of 3 frames" in output and "--ego kiss_icp" in output) == bool(unknown)


def test_neighbour_classes_and_truncated_labels_are_ignored():
    vans = make_drive(kind=VAN)
    assert score_drive(vans) is None
    truncated_frames = [
        (GroundTruth.of(t.boxes, t.class_ids, [{**e, "truncated": 2.0} for e in t.extras]), k) for t, k in make_drive()
    ]
    assert score_drive(truncated_frames) is None
    behind = [
        (
            GroundTruth.of(t.boxes - [60.0, 0, 0, 0, 0, 0, 0], t.class_ids, t.extras),
            to_tracked_labels(np.arange(1), Detections.of(t.boxes[:1] - 30.0, CAR, 0.9)),
        )
        for t, _ in make_drive()
    ]
    assert score_drive(behind, calibration=FORWARD_CAMERA) is None
    assert score_drive(behind)["misses"] == 2 * score_drive(behind)["false"] == 20


def test_track_in_dont_care_region_is_not_a_false_positive():
    ((_, tracks),) = make_drive(frames=1)
    wide = GroundTruth.of(
        [],
        [],
        [],
        [
            (
                "DontCare",
                {
                    "bbox": [0.0, 0.0, 1241.0, 374.0],
                    "track_id": -1,
                    "truncated": -1.0,
                    "occluded": -1,
                    "alpha": -10.0,
                    "dimensions": [-1.0] * 3,
                    "location": [-1000.0] * 3,
                    "rotation_y": -10.0,
                },
            )
        ],
    )
    nothing = GroundTruth.of([], [])
    assert score_drive([(wide, tracks)], calibration=FORWARD_CAMERA) is None
    assert score_drive([(nothing, tracks)], calibration=FORWARD_CAMERA)["false"] == 2


def test_empty_tracks_or_labels_count_as_errors():
    nothing = GroundTruth.of([], [])
    missed = score_drive([(truth, nothing) for truth, _ in make_drive()])
    assert (missed["misses"], missed["HOTA"], missed["sAMOTA"]) == (20, 0.0, 0.0)
    false = score_drive([(nothing, tracks) for _, tracks in make_drive()])
    assert (false["false"], false["HOTA"], false["MOTA"]) == (20, 0.0, -20.0)
    assert score_drive([(nothing, nothing)]) is None


def test_error_explains_why_tracks_cannot_be_scored():
    truth, tracks = make_drive(frames=1)[0]
    twice = to_tracked_labels(np.array([3, 3]), Detections.of(tracks.boxes, CAR))
    with pytest.raises(InputError, match="a/0: a frame contains the track id 3 twice"):
        make_observation("a", 0, truth, twice)
    with pytest.raises(InputError, match="no track id"):
        make_pairs(GroundTruth.of(truth.boxes, truth.class_ids), tracks, None)
    frame = Frame(
        "a/0", 0, lambda: 1 / 0, lambda: GroundTruth.of(truth.boxes, truth.class_ids, [{"track_id": -1}] * len(truth))
    )  # KITTI writes none
    measure = measure_tracking(lambda: None, TrackingParams(), "none", Recording("a", "", [frame], frozenset()))
    with pytest.raises(InputError, match="no track id"):  # reported before the scan is loaded
        measure(frame)


def test_result_file_survives_writing_and_reading(tmp_path):
    frames = [
        (i, np.array([4, 9]), Detections.of(tracks.boxes, [CAR, 4], [0.25, 0.75]))
        for i, (_, tracks) in enumerate(make_drive(frames=3))
    ]
    path = tmp_path / "0000.txt"
    write_tracking_results(path, frames, FORWARD_CAMERA)
    found = read_tracking_labels(path, FORWARD_CAMERA.lidar_to_camera)
    assert " Person " in path.read_text()  # name of Person_sitting in the tracking benchmark
    for number, _, detections in frames:
        read_tracks = found[number]
        np.testing.assert_allclose(read_tracks.boxes, detections.boxes, atol=2e-6)
        assert read_tracks.class_ids.tolist() == detections.class_ids.tolist()
        assert [(e["track_id"], e["score"]) for e in read_tracks.extras] == [(4, 0.25), (9, 0.75)]
