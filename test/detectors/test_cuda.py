"""Results on CUDA agree with the CPU; skipped without a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.weights_file import POINTPILLARS_WEIGHTS
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.types import Detections

pytestmark = [
    pytest.mark.no_cover,
    pytest.mark.usefixtures("streets"),
    pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here"),
]
DETECTORS = [*sorted(POINTPILLARS_WEIGHTS.glob("*.safetensors")), "pointnet", "fused"]
SURE = 0.3  # detections with at least this score must exist on both devices


@pytest.fixture(scope="module")
def scan(streets):
    return simulate_scan(12, 0, HDL64E).frame


def assert_alike(a: Detections, b: Detections, metres: float = 0.05, score: float = 0.03) -> None:
    """Assert that each detection above SURE has a counterpart with similar position and score. CUDA convolutions
    use TF32, which has three significant digits.
    """
    assert (a.scores > SURE).sum() > 3
    for detections, other in ((a, b), (b, a)):
        for k in np.flatnonzero(detections.scores > SURE + score):
            distances = np.abs(other.boxes[:, :6] - detections.boxes[k, :6]).max(axis=1)
            distances[other.class_ids != detections.class_ids[k]] = np.inf
            nearest = int(distances.argmin())
            assert distances[nearest] < metres and abs(other.scores[nearest] - detections.scores[k]) < score


@pytest.mark.parametrize("weights", DETECTORS, ids=lambda path: getattr(path, "stem", path))
def test_detections_on_cuda_equal_those_on_cpu(weights, scan):
    cpu_detector, cuda_detector = (open_detector(weights, device) for device in ("cpu", "cuda"))
    result = cuda_detector(scan)
    assert result.problem is None and cuda_detector.device == "cuda"
    assert_alike(cpu_detector(scan).detections, result.detections)


def test_detections_all_around_on_cuda_equal_those_on_cpu(scan):
    cpu_detector, cuda_detector = (open_detector(device=device, range="around") for device in ("cpu", "cuda"))
    assert_alike(cpu_detector(scan).detections, cuda_detector(scan).detections)


@pytest.mark.parametrize("weights", ["pointnet", "fused"])
def test_cpu_fallback_is_reported(weights, scan):
    detector = open_detector(weights, "cuda")
    cuda_detections = detector(scan).detections
    torch.cuda.empty_cache()
    torch.cuda.set_per_process_memory_fraction(1e-6)
    try:
        result = detector(scan)
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
    assert "out of memory" in result.problem
    assert_alike(cuda_detections, result.detections)
