"""CUDA computes what the CPU does; where there is no GPU these tests are skipped."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from detection_samples import BOXES, tiny, two_objects

from lidar_perception.classes import CAR
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointpillars.network import channels_last, make_network
from lidar_perception.detectors.pointpillars.weights_file import WEIGHTS
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.drive import scan_at
from lidar_perception.simulation.sensor import HDL64E
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.params import AugmentParams, LoopParams
from lidar_perception.training.pointpillars.task import Preparation, make_loss
from lidar_perception.training.run import Run, Task
from lidar_perception.types import PEDESTRIAN, Detections

pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("streets"),
              pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU here")]
DETECTORS = [*sorted(WEIGHTS.glob("*.safetensors")), "pointnet", "fused"]
SURE = 0.3  # a score from which on a detection is in both


@pytest.fixture(scope="module")
def scan(streets):
    return scan_at(12, 0, HDL64E).frame


def assert_alike(a: Detections, b: Detections, metres: float = 0.05, score: float = 0.03) -> None:
    """Whatever is surely found by one is found by the other, at the same place and as likely.
    Convolutions of CUDA multiply in TF32, which has three digits."""
    assert (a.scores > SURE).sum() > 3
    for one, other in ((a, b), (b, a)):
        for k in np.flatnonzero(one.scores > SURE + score):
            apart = np.abs(other.boxes[:, :6] - one.boxes[k, :6]).max(axis=1)
            apart[other.class_ids != one.class_ids[k]] = np.inf
            same = int(apart.argmin())
            assert apart[same] < metres and abs(other.scores[same] - one.scores[k]) < score


@pytest.mark.parametrize("weights", DETECTORS, ids=lambda path: getattr(path, "stem", path))
def test_a_detector_finds_on_cuda_what_it_finds_on_the_cpu(weights, scan):
    here, there = (open_detector(weights, device) for device in ("cpu", "cuda"))
    found = there(scan)
    assert found.problem is None and there.device.type == "cuda"
    assert_alike(here(scan).detections, found.detections)


def test_all_around_too(scan):
    here, there = (open_detector(device=device, where="around") for device in ("cpu", "cuda"))
    assert_alike(here(scan).detections, there(scan).detections)


@pytest.mark.parametrize("weights", ["pointnet", "fused"])
def test_without_memory_the_cpu_takes_over_and_says_so(weights, scan):
    detector = open_detector(weights, "cuda")
    on_cuda = detector(scan).detections
    torch.cuda.empty_cache()
    torch.cuda.set_per_process_memory_fraction(1e-6)
    try:
        found = detector(scan)
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0)
    assert "out of memory" in found.problem
    assert_alike(on_cuda, found.detections)


def run_on(device: str, version: str, amp: str) -> tuple[Run, list]:
    torch.manual_seed(0)
    config = tiny(version)
    still = with_values(AugmentParams(), {name: 0.0 for name in (
        "crowded", "object_turn", "object_shift", "flip", "turn", "scale", "dropout", "intensity",
        "height", "tilt", "beam_noise", "range_noise")})
    scene = TrainingScene(points=two_objects(), boxes=BOXES.numpy().astype(np.float64),
                          wanted=np.ones(2, bool), class_ids=np.array([CAR, PEDESTRIAN]))
    batch = [Preparation(config, still)(scene, np.random.default_rng(0))] * 2
    place = torch.device(device)
    network = channels_last(make_network(config).to(place))
    params = LoopParams(steps=40, batch=2, lr=0.01, amp=amp)
    return Run(Task(network, make_loss(config, place), lambda step: [], lambda module: ({}, {}),
                    lambda *_: None, 1), params, place), batch


@pytest.mark.parametrize("version", ["v0", "v3", "v4"])
def test_a_step_of_training_is_that_of_the_cpu(version):
    (here, batch), (there, _) = (run_on(device, version, "off") for device in ("cpu", "cuda"))
    for _ in range(3):
        ours, theirs = here.step(batch), there.step(batch)
        assert {name: pytest.approx(value, rel=0.02) for name, value in ours.items()} == theirs


def test_it_learns_in_16_bits():
    run, batch = run_on("cuda", "v4", "auto")
    assert run.format is torch.bfloat16
    losses = [run.step(batch)["loss"] for _ in range(run.steps)]
    assert losses[-1] < 0.3 * losses[0] and run.progress.skipped == 0
    state = run.state()
    again, _ = run_on("cuda", "v4", "auto")
    again.load(state)
    assert all(torch.equal(a, b) for a, b in zip(run.module.state_dict().values(),
                                                 again.module.state_dict().values()))
