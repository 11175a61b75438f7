"""Training on CUDA agrees with training on the CPU; skipped without a GPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from detection_samples import BOXES, make_tiny_config, make_two_objects
from training_toy import STILL

from lidar_perception.classes import CAR
from lidar_perception.detectors.pointpillars.network import make_network, to_channels_last
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.params import LoopParams
from lidar_perception.training.pointpillars.task import ScenePreparation, make_loss
from lidar_perception.training.run import Run, Task
from lidar_perception.types import PEDESTRIAN

pytestmark = [pytest.mark.no_cover, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]


def run_on(device: str, version: str, amp: str) -> tuple[Run, list]:
    torch.manual_seed(0)
    config = make_tiny_config(version)
    scene = TrainingScene(
        points=make_two_objects(),
        boxes=BOXES.numpy().astype(np.float64),
        detectable=np.ones(2, bool),
        class_ids=np.array([CAR, PEDESTRIAN]),
    )
    batch = [ScenePreparation(config, STILL)(scene, np.random.default_rng(0))] * 2
    place = torch.device(device)
    network = to_channels_last(make_network(config).to(place))
    params = LoopParams(steps=40, batch=2, lr=0.01, amp=amp)
    return Run(
        Task(network, make_loss(config, place), lambda step: [], lambda module: ({}, {}), lambda *_: None, 1),
        params,
        place,
    ), batch


@pytest.mark.parametrize("version", ["v0", "v3", "v4"])
def test_training_step_agrees_with_cpu(version):
    (on_cpu, batch), (on_cuda, _) = (run_on(device, version, "off") for device in ("cpu", "cuda"))
    for _ in range(3):
        ours, theirs = on_cuda.step(batch), on_cpu.step(batch)
        assert {name: pytest.approx(value, rel=0.02) for name, value in ours.items()} == theirs


def test_training_in_16_bits_lowers_loss():
    run, batch = run_on("cuda", "v4", "auto")
    assert run.dtype is torch.bfloat16
    losses = [run.step(batch)["loss"] for _ in range(run.steps)]
    assert losses[-1] < 0.3 * losses[0] and run.progress.skipped == 0
    state = run.make_state()
    second_loss, _ = run_on("cuda", "v4", "auto")
    second_loss.load(state)
    assert all(
        torch.equal(a, b) for a, b in zip(run.module.state_dict().values(), second_loss.module.state_dict().values())
    )
