"""Custom detectors: classes given by reference or entry point."""

from __future__ import annotations

from importlib.metadata import EntryPoint

import numpy as np
import pytest
from samples import make_scene

from experiments.comparison.contenders import _make_name
from lidar_perception.detectors import custom
from lidar_perception.detectors.open import make_default_params, open_detector, resolve_weights
from lidar_perception.types import Detections, InputError, RunError

MODULE = """
import lidar_perception as lp

class Fixed:
    classes = ("Pedestrian", "Car")
    def __init__(self, sensor_height=1.73, device="auto"):
        self.height, self.device = sensor_height, device
    def __call__(self, cloud):
        boxes = [[5, 0, 0, 1, 1, self.height, 0], [9, 0, 0, 1, 1, len(cloud), 0]]
        return lp.Detections.of(boxes, [3, 0], [0.9, 0.3])

class Returns:
    def __call__(self, cloud):
        return cloud.xyz

class Fails:
    def __init__(self):
        raise OSError("no\\nmodel")

class NoCall:
    pass

class OddClasses(Fixed):
    classes = ("Pedestrain",)

value = 3
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Name of a module in the current folder, imported again by each test."""
    name = f"own_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(MODULE)
    (tmp_path / f"{name}_broken.py").write_text("import nothing_there")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*custom.sys.path])
    return name


def test_own_detector_receives_sensor_height_and_device(module):
    detector = open_detector(f"{module}:Fixed", "cpu", sensor_height=0.5)
    assert detector.classes == ("Pedestrian", "Car")
    result = detector(make_scene(0))
    assert result.detections.boxes[0, 5] == 0.5
    higher_detector = detector.with_sensor_height(2.0)
    assert higher_detector(make_scene(0)).detections.boxes[0, 5] == 2.0
    assert detector(make_scene(0)).detections.boxes[0, 5] == 0.5
    assert detector.build(0.5).device == "cpu" and detector.build(0.5) is detector.build(0.5)


def test_detections_below_the_threshold_are_dropped(module):
    detector = open_detector(f"{module}:Fixed")
    assert len(detector(make_scene(0)).detections) == 2 and detector.min_scores["Car"] == 0.0
    assert len(detector.with_min_score(0.5)(make_scene(0)).detections) == 1
    strict_detector = open_detector(f"{module}:Fixed", settings={"custom.scores.pedestrian": 0.95})
    assert strict_detector(make_scene(0)).detections.class_ids.tolist() == [0]


def test_own_detector_receives_cropped_finite_points(module):
    cloud = make_scene(0)
    cloud[:5] = np.nan
    point_count = open_detector(f"{module}:Fixed")(cloud).detections.boxes[1, 5]
    assert point_count == len(cloud) - 5
    cropped_detector = open_detector(f"{module}:Fixed", settings={"crop.max_range": 9.0})
    assert 0 < cropped_detector(cloud).detections.boxes[1, 5] < point_count


@pytest.mark.parametrize(
    "reference, message",
    [
        ("{}:Fixd", "has no class 'Fixd'; did you mean 'Fixed'"),
        ("{}:value", "is of type int, not a class"),
        ("{}:Fails", "cannot create .*: OSError: no model"),
        ("{}:NoCall", "has no method __call__"),
        ("{}:OddClasses", "did you mean 'Pedestrian'"),
        ("{}_broken:Fixed", "cannot import .*: ModuleNotFoundError: No module named 'nothing_there'"),
        ("{}_absent:Fixed", "no module named"),
    ],
)
def test_unsuitable_class_is_rejected_in_one_line(module, reference, message):
    with pytest.raises(InputError, match=message) as error:
        open_detector(reference.format(module))
    assert "\n" not in str(error.value)


def test_range_is_rejected_if_the_class_has_no_such_argument(module):
    with pytest.raises(InputError, match="has no argument `range`"):
        open_detector(f"{module}:Fixed", range="around")


def test_wrong_return_type_of_own_detector_ends_the_run(module):
    with pytest.raises(RunError, match="returned ndarray instead of Detections"):
        open_detector(f"{module}:Returns")(make_scene(0))


def test_entry_point_names_a_class(module, monkeypatch):
    points = [EntryPoint("mine", f"{module}:Fixed", custom.ENTRY_POINTS)]
    monkeypatch.setattr(custom, "entry_points", lambda group: points)
    assert resolve_weights("mine") == ("mine", None)
    assert len(open_detector("mine")(make_scene(0)).detections) == 2
    assert make_default_params("mine") == custom.CustomDetectorParams()
    with pytest.raises(InputError, match=r"Valid names: .*, mine"):
        open_detector("mime")


def test_function_becomes_a_detector():
    detector = custom.as_detector(lambda cloud: Detections.of([1, 0, 0, 1, 1, 1, 0], 3, 0.5))
    assert len(detector(make_scene(0)).detections) == 1
    assert custom.as_detector(detector) is detector


def test_comparison_names_class_by_its_reference(module):
    detector = open_detector(f"{module}:Fixed")
    assert _make_name(detector, ["fused"]) == f"{module}:Fixed"
    assert _make_name(detector, [f"{module}:Fixed"]) == f"{module}:Fixed #2"
