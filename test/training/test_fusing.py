"""Fusion of other weights: curves are probabilities, and damaged files are rejected."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from cli_samples import read_error_line, run_main
from detection_samples import are_equal_detections, make_random_detector, make_scan
from fuzz.mutation import mutate_text
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit

from experiments.comparison.contenders import open_contenders
from lidar_perception.camera import Camera
from lidar_perception.classes import CAR, DETECTED
from lidar_perception.data.frame import Frame
from lidar_perception.detectors.checkpoint import read_header, save_header
from lidar_perception.detectors.fused.detector import FusedDetector, Proposals, load_fused_detector
from lidar_perception.detectors.fused.evidence import compute_probabilities
from lidar_perception.detectors.fused.fusion import (
    KNOTS,
    SHIPPED_FILE,
    find_fused_weights,
    find_fusion,
    load_shipped_models,
    read_fusion,
    write_fusion,
)
from lidar_perception.detectors.fused.params import FusedParams
from lidar_perception.detectors.open import check_weights, open_detector
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointpillars.params import PointPillarsParams
from lidar_perception.detectors.weights_file import (
    find_pointnet_weights,
    find_pointpillars_weights,
    find_proposer_weights,
)
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.camera import FORWARD_CAMERA
from lidar_perception.training import fusion_curves
from lidar_perception.training.fusion_curves import (
    CLOUD_KINDS,
    MIN_SAMPLES,
    WITH_INTENSITY,
    WITHOUT_INTENSITY,
    Samples,
    collect_samples,
    fit_class,
    fit_classes,
)
from lidar_perception.training.params import FusedTraining, PointNetTraining
from lidar_perception.training.pointnet.trainer import find_proposer
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, GroundTruth, InputError

pytestmark = pytest.mark.usefixtures("one_thread")
SEEDS = st.integers(0, 2**32 - 1)


def draw_samples(rng, count: int, class_id: int, odds: float = -1.5) -> Samples:
    """Draw proposals whose log-odds have mean `odds`, and noisy sources of these log-odds."""
    true = rng.normal(odds, 2.0, count)
    evidence = {name: np.clip(true + rng.normal(0, 0.5, count), -6.5, 6.5) for name in KNOTS}
    evidence["silhouette"][rng.random(count) < 0.2] = np.nan
    return Samples(np.full(count, class_id), rng.random(count) < expit(true), rng.integers(0, 60, count), evidence)


@settings(max_examples=5)
@given(SEEDS)
def test_fitted_scores_are_probabilities_in_any_order_of_scans(seed):
    rng = np.random.default_rng(seed)
    own = draw_samples(rng, 4000, PEDESTRIAN)
    models, fits = fit_classes(own, load_shipped_models())
    other = draw_samples(rng, 20_000, PEDESTRIAN)
    scores = compute_probabilities(models, other.class_ids, other.evidence)
    for low in np.arange(0.1, 0.9, 0.2):
        in_bin = (scores >= low) & (scores < low + 0.2)
        assert abs(other.correct[in_bin].mean() - scores[in_bin].mean()) < 0.08
    assert fits["Pedestrian"].new_score.loss < fits["Pedestrian"].old_score.loss
    assert fits["Pedestrian"].proposals == 4000
    assert fits["Pedestrian"].correct == own.correct.sum()
    permuted_models, _ = fit_classes(own.take(rng.permutation(4000)), load_shipped_models())
    for curve, before in zip(permuted_models["Pedestrian"]["curves"].values(), models["Pedestrian"]["curves"].values()):
        np.testing.assert_allclose(curve["values"], before["values"], atol=0.02)
    # A class with too few samples keeps its curves.
    assert models["Car"] == load_shipped_models()["Car"] and fits["Car"].new_score is None


def test_separate_curves_are_fitted_without_intensity(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    samples = {kind: draw_samples(rng, 2000, PEDESTRIAN, odds) for kind, odds in zip(CLOUD_KINDS, (-1.5, 1.0))}
    monkeypatch.setattr(fusion_curves, "simulate_samples", lambda *_: samples)
    fits = fusion_curves.fit_fusion(None, None, tmp_path / "fused.json", FusedTraining())
    fusion, shipped = read_fusion(tmp_path / "fused.json"), find_fusion()
    for kind, models, before in (
        (WITH_INTENSITY, fusion.models, shipped.models),
        (WITHOUT_INTENSITY, fusion.models_without_intensity, shipped.models_without_intensity),
    ):
        assert models["Pedestrian"]["bias"] == fit_class("Pedestrian", samples[kind])["bias"]
        assert models["Car"] == before["Car"]
        assert fits[kind]["Pedestrian"].correct == samples[kind].correct.sum()


def test_curves_are_not_fitted_to_too_few_samples():
    rng = np.random.default_rng(0)
    for right in (0, MIN_SAMPLES // 2 - 1, MIN_SAMPLES * 3):
        own = draw_samples(rng, 500, CAR)
        own.correct[:] = np.arange(500) < right
        own.scans[:] = np.arange(500) % 2
        models, fits = fit_classes(own, load_shipped_models())
        assert (models["Car"] == load_shipped_models()["Car"]) == (right < MIN_SAMPLES)
        assert (fits["Car"].new_score is None) == (right < MIN_SAMPLES)
        models, _ = fit_classes(own, {"Cyclist": models["Cyclist"]})  # a new class
        assert ("Car" in models) == (right >= MIN_SAMPLES)


@pytest.mark.parametrize("camera", [None, FORWARD_CAMERA], ids=["all around", "in an image"])
def test_objects_count_once_and_vans_are_ignored(camera: Camera | None):
    car, person = [10, 0, -0.9, 4, 1.7, 1.5, 0], [12, 4, -0.8, 0.6, 0.6, 1.8, 0]
    behind, van = [-10, 0, -0.9, 4, 1.7, 1.5, 0], [10, 5, -0.7, 4.7, 1.9, 2.0, 0]
    nearly = np.add(person, [0.3, 0.2, 0, 0, 0, 0, 0])
    found = Detections.of(
        np.array([car, car, behind, person, nearly, car, van]),
        [CAR] * 3 + [PEDESTRIAN] * 3 + [CAR],
        [0.3, 0.8, 0.9, 0.2, 0.5, 0.7, 0.9],
    )
    truth = GroundTruth.of(np.array([car, behind, person, van]), [CAR, CAR, PEDESTRIAN, CLASSES.index("Van")])
    scan = make_scan()
    look = Proposals(found, {"network": np.arange(7.0)}, scan.xyz, scan.xyz[:0], None, {}, {})
    own = collect_samples(Frame.of("street", scan, truth, camera), look, 7)
    expected = {1.0: True, 2.0: True, 4.0: True, 5.0: False}
    if camera is not None:
        del expected[2.0]  # the car behind
    assert dict(zip(own.evidence["network"].tolist(), own.correct.tolist())) == expected
    assert set(own.scans.tolist()) == {7}


@pytest.fixture
def others(tmp_path):
    """Write a fusion file for a copy of the PointNet with curves that differ from the package's."""
    classifier = tmp_path / "own/pointnet.safetensors"
    classifier.parent.mkdir()
    classifier.write_bytes(find_pointnet_weights(PointNetParams()).read_bytes())
    models = json.loads(json.dumps(load_shipped_models()))
    for model in models.values():
        model["bias"] += 1.0
    dark = {name: {**model, "bias": model["bias"] - 2.0} for name, model in models.items()}
    write_fusion(tmp_path / "fused.json", (None, classifier), models, {"scans": 3}, dark)
    return tmp_path / "fused.json", models


def test_fusion_file_can_be_read_after_its_folder_is_moved(others, tmp_path, monkeypatch):
    path, models = others
    fusion = read_fusion(path)
    assert fusion.models == models and fusion.fitted_to == {"scans": 3}
    assert fusion.models_without_intensity["Car"]["bias"] == pytest.approx(models["Car"]["bias"] - 2)
    assert fusion.curve_warning is None
    assert fusion.proposer == find_proposer_weights()
    new_folder = tmp_path.parent / f"{tmp_path.name}-moved"
    tmp_path.rename(new_folder)
    read_models = read_fusion(new_folder / "fused.json")
    assert read_models.classifier == new_folder / "own/pointnet.safetensors" and read_models.curve_warning is None
    monkeypatch.chdir(new_folder)
    assert open_detector("fused.json", "cpu").models == models
    assert find_fused_weights(FusedParams(weights="fused.json")).name == "fused.json"
    # Changed or missing weights.
    read_models.classifier.write_bytes(read_models.classifier.read_bytes() + b"\0")
    assert "pointnet.safetensors, so its scores" in read_fusion(new_folder / "fused.json").curve_warning
    read_models.classifier.unlink()
    with pytest.raises(InputError, match=r"refers to .*pointnet.safetensors, which does not exist"):
        read_fusion(new_folder / "fused.json")


@pytest.mark.parametrize("curves", [[], 0, "", {}, {"Car": {}}])
def test_invalid_classes_without_intensity_are_rejected(curves, tmp_path):
    path = tmp_path / "fused.json"
    path.write_text(json.dumps({**json.loads(SHIPPED_FILE.read_text()), "classes_without_intensity": curves}))
    with pytest.raises(InputError, match=r"fused.json was not written by"):
        read_fusion(path)


def test_pointnet_trains_with_the_proposer_of_fused():
    assert find_proposer(PointNetTraining(proposer="package")) == find_fusion().proposer


def test_shipped_curves_warn_about_other_weights(others):
    path, _ = others
    assert find_fusion().curve_warning is None and check_weights(SHIPPED_FILE, 1.73) == []
    assert open_detector("fused", "cpu").warning is None
    other = str(find_pointpillars_weights(PointPillarsParams(version="v1")))
    for params in FusedParams(weights=other), FusedParams(classifier=other):
        assert f"not fitted to {other}" in find_fusion("", params).curve_warning
        assert find_fusion("", params).models == load_shipped_models()
    with pytest.raises(InputError, match=r"already refers to PointNet weights; leave fused.classifier"):
        find_fusion(path, FusedParams(classifier=other))
    for group in "weights", "classifier":
        with pytest.raises(InputError, match=rf"checkpoint not found: nowhere; .* fused.{group}"):
            find_fusion("", FusedParams(**{group: "nowhere"}))


def test_missing_class_and_foreign_sensor_are_reported(others):
    path, models = others
    classifier = path.parent / "own/pointnet.safetensors"
    save_header(classifier, replace(read_header(classifier), training={"sensor": {"name": "vlp-16", "height": 0.6}}))
    del models["Cyclist"]
    write_fusion(path, (None, classifier), models, {})
    never, other = check_weights(path, 1.73)
    assert never.startswith("fused does not detect Cyclist, because it has curves only for")
    assert str(classifier) in other and "the sensor vlp-16 at 0.6 m" in other
    assert open_detector(path, "cpu").warning == never


def test_detector_uses_curves_of_its_file_at_any_range(others):
    path, models = others
    own_detector, package_detector = load_fused_detector(path, "cpu"), load_fused_detector("", "cpu")
    mine = FusedDetector(make_random_detector("v4").proposer, own_detector.classifier, own_detector.params, models)
    theirs = FusedDetector(mine.proposer, package_detector.classifier, package_detector.params)
    scan = make_scan()
    odds = [detector.with_min_score(0.0)(scan).detections for detector in (mine, theirs)]
    assert len(odds[0]) and not are_equal_detections(*odds)
    around = own_detector.with_range("around")
    assert around.models is own_detector.models and around.warning is None
    half = with_values(own_detector.params, {"fused.amp": "bf16", "fused.warm_up": False})
    assert load_fused_detector(path, "cpu", half).proposer.network.amp == "bf16"


def test_damaged_file_is_accepted_or_rejected_in_one_line(tmp_path):
    rng, path, rejected_count = np.random.default_rng(0), tmp_path / "damaged.json", 0
    evidence = {name: np.array([-9.0, 0.0, np.nan, np.inf]) for name in KNOTS}
    for _ in range(100):
        path.write_text(mutate_text(SHIPPED_FILE.read_text(), rng)[0])
        try:
            models = read_fusion(path).models
        except InputError as error:
            assert "damaged.json" in str(error) and "\n" not in str(error)
            rejected_count += 1
            continue
        for name in DETECTED:
            scores = compute_probabilities(models, np.full(4, CLASSES.index(name)), evidence)
            assert ((scores >= 0) & (scores <= 1)).all()
    assert 15 < rejected_count < 100


def test_fusion_file_is_compared_as_separate_detector(others):
    found = {each.name: each.source for each in open_contenders([others[0]], "cpu")[0]}
    assert found["fused #2"] == str(others[0]) and found["fused"] != found["fused #2"]


def test_train_fused_writes_usable_file(tmp_path, monkeypatch, capsys):
    out = tmp_path / "made/fused.json"
    command = [
        "train",
        "fused",
        "--sensor",
        "vlp-16",
        "--mount-height",
        "1.0",
        "--scans",
        "2",
        "--range",
        "around",
        "--jobs",
        "1",
        "--out",
        out,
    ]
    assert run_main(monkeypatch, *command) == 0
    printed = capsys.readouterr()
    assert "2 street,campus,indoor scans of vlp-16 at 1 m, all around" in printed.err
    assert "too few samples to fit curves" in " ".join(printed.out.split())
    fusion = read_fusion(out)
    assert fusion.models == load_shipped_models() and fusion.curve_warning is None
    assert fusion.models_without_intensity == find_fusion().models_without_intensity != fusion.models
    assert fusion.fitted_to["sensor"] == "vlp-16" and fusion.fitted_to["range"] == "around"
    before = out.read_bytes()
    assert run_main(monkeypatch, *command) == 2 and "already exists" in read_error_line(capsys)
    assert run_main(monkeypatch, "train", "fused", "--out", tmp_path / "fused") == 2
    assert "must end with .json" in read_error_line(capsys)
    assert out.read_bytes() == before
