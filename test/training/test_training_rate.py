"""Learning rate and weight average, also if the time ends before the planned steps."""

from __future__ import annotations

import signal
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import nn
from training_toy import PARAMS, Toy, are_equal, are_equal_runs, read_rows

from lidar_perception.training import loop
from lidar_perception.training.loop import train
from lidar_perception.training.params import LoopParams
from lidar_perception.training.run import Progress, Run
from lidar_perception.training.schedule import WeightAverage, compute_one_cycle

pytestmark = [
    pytest.mark.no_cover,  # covered by other tests
    pytest.mark.usefixtures("one_thread_for_all"),
]
PLANNED = LoopParams(**{**vars(PARAMS), "steps": 300, "validate_steps": 60, "save_steps": 300})


@given(st.integers(3, 300), st.floats(0.05, 0.95))
def test_learning_rate_equals_one_cycle_of_torch(steps, warm):
    parameter = nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.AdamW([parameter], lr=1.0)
    if warm * steps <= 1.01:
        return  # torch divides by zero
    scheduler = torch.optim.lr_scheduler.OneCycleLR(optimizer, 0.01, total_steps=steps, pct_start=warm, div_factor=10)
    for step in range(steps):
        group = optimizer.param_groups[0]
        rate, momentum = compute_one_cycle(step, steps, 0.01, warm)
        assert rate == pytest.approx(group["lr"], rel=1e-6, abs=1e-12)
        assert momentum == pytest.approx(group["betas"][0], rel=1e-6)
        optimizer.step()
        if step + 1 < steps:
            scheduler.step()


@pytest.mark.parametrize("warm", [0.01, 0.25, 0.5, 0.99])
@pytest.mark.parametrize("steps", [1, 2, 3, 4, 100])
def test_learning_rate_is_positive_in_the_shortest_runs(steps, warm):
    assert all(0 < compute_one_cycle(i, steps, 0.1, warm)[0] <= 0.1 for i in range(steps))


@given(st.lists(st.floats(-10, 10), min_size=1, max_size=30), st.floats(0, 0.99))
def test_average_is_weighted_sum_of_weights(values, decay):
    module = nn.Linear(1, 1, bias=False).double()
    average = WeightAverage(module, decay)
    shares = []
    for t, value in enumerate(values, 1):
        module.weight.data.fill_(value)
        average.update(module)
        keep = min(decay, t / (t + 9))
        shares = [share * keep for share in shares] + [1 - keep]
    start = 1 - sum(shares)  # weight of the initial parameters
    expected = sum(s * v for s, v in zip(shares, values))
    first = average.module.weight.item() - expected
    assert abs(first) <= abs(start) + 1e-9
    if decay == 0:
        assert average.module.weight.item() == values[-1]


def test_average_includes_norm_statistics():
    module = nn.BatchNorm1d(2)
    average = WeightAverage(module, 0.0)
    module.train()(torch.randn(8, 2) + 4)
    average.update(module)
    assert are_equal(average.module.state_dict(), module.state_dict())
    assert not any(p.requires_grad for p in average.module.parameters())


def test_norm_statistics_start_as_mean_over_steps():
    toy = Toy()
    run, norm = Run(toy.task(), PARAMS, torch.device("cpu")), toy.module[1]
    norm.momentum = 0.0
    run.norms = [(norm, 0.01)]
    samples = []
    toy.module[0].register_forward_hook(lambda *call: samples.append(call[2].mean(dim=0).detach()))
    for batch, _ in zip(toy.batches(0), range(5)):
        run.step(batch)
    assert torch.allclose(norm.running_mean, torch.stack(samples).mean(dim=0), atol=1e-6)


# a budget that is too short


def run_timed(seconds, validation: float, folder: Path, monkeypatch, **others) -> tuple[Toy, Progress]:
    """Run PLANNED on a fake clock, with steps of seconds(step)."""
    now = [0.0]
    monkeypatch.setattr(loop.time, "monotonic", lambda: now[0])
    toy = Toy(lambda step: now.__setitem__(0, now[0] + seconds(step)))
    validate = toy.validate

    def validate_slowly(module):
        now[0] += validation
        return validate(module)

    toy.validate = validate_slowly
    return toy, train(toy.task(), PLANNED, folder, validation_s=validation, **others)


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned")
    train(Toy().task(), PLANNED, folder)
    return folder


@pytest.mark.parametrize("fits", [0.2, 0.5, 0.8])
@pytest.mark.parametrize(
    "seconds", [lambda _: 10.0, lambda step: 4.0 if step < 50 else 12.0, lambda step: 6.0 + 6.0 * (step % 7)]
)
def test_slow_run_ends_in_time_at_the_final_learning_rate(seconds, fits, planned, tmp_path, monkeypatch, capsys):
    first = int(fits * 300)
    until = sum(seconds(step) for step in range(first)) + 30.0 * (first // 60 + 1)
    toy, progress = run_timed(seconds, 30.0, tmp_path, monkeypatch, deadline=until)
    assert not progress.late and loop.time.monotonic() <= until
    assert 0.85 * first <= progress.step <= first
    assert 300 <= progress.step + progress.left_out < 301
    assert capsys.readouterr().err.count("steps fit into the budget") == 1
    rates, whole = ([float(row["lr"]) for row in read_rows(folder)] for folder in (tmp_path, planned))
    assert rates[-1] == whole[-1] and max(rates) > 0.95 * max(whole)
    jumps, slope = (max(abs(a - b) for a, b in pairwise(each)) for each in (rates, whole))
    assert jumps < 3 * slope / fits  # no sudden drop
    assert set(toy.saved) == {"best", "last"}


def test_sufficient_budget_keeps_the_plan(planned, tmp_path, monkeypatch):
    _, progress = run_timed(lambda _: 1.0, 30.0, tmp_path, monkeypatch, deadline=600.0)
    assert progress.left_out == 0 and are_equal_runs(tmp_path, planned)


def test_shortened_run_resumes_where_it_stopped(tmp_path, monkeypatch):
    def stop(step):
        if step == 40:
            signal.raise_signal(signal.SIGTERM)
        return 10.0

    _, before = run_timed(stop, 0.0, tmp_path, monkeypatch, deadline=1500.0)
    assert before.stopped and before.left_out > 10
    progress = train(Toy().task(), PLANNED, tmp_path, resume=True)
    rates = [float(row["lr"]) for row in read_rows(tmp_path)]
    assert progress.left_out == pytest.approx(before.left_out, abs=1)
    assert rates[-1] < 1e-3 * PLANNED.lr and progress.step + progress.left_out >= 300
    assert max(abs(a - b) for a, b in pairwise(rates[45:])) < 0.02 * PLANNED.lr
