"""Laws of the training loop: what a stop, a kill, a full disk or a NaN may change, and what not."""

from __future__ import annotations

import csv
import errno
import multiprocessing
import os
import signal
import socket
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from lidar_perception.runs import files
from lidar_perception.training import loop
from lidar_perception.training.loop import STATE, train
from lidar_perception.training.params import LoopParams, PointPillarsTraining
from lidar_perception.training.ranks import joined, rank, world
from lidar_perception.training.run import Progress, Run, Task
from lidar_perception.training.schedule import Average, one_cycle
from lidar_perception.types import InputError

few = settings(max_examples=25, database=None)
CPU = torch.device("cpu")
PARAMS = LoopParams(steps=13, validate_steps=4, save_steps=3, log_steps=1, seed=3, lr=0.05,
                    amp="off")


pytestmark = pytest.mark.usefixtures("one_thread_for_all")


class Toy:
    """A regression with dropout and batch norm. before(step) runs in the loss of each step."""

    def __init__(self, before=lambda step: None, plain: bool = False, size: int = 8):
        torch.manual_seed(5)
        middle = [] if plain else [nn.BatchNorm1d(6), nn.Dropout(0.3)]
        self.module = nn.Sequential(nn.Linear(4, 6), *middle, nn.ReLU(), nn.Linear(6, 1))
        self.before, self.size, self.kept = before, size, {}

    def task(self, **about) -> Task:
        return Task(self.module, self.loss, self.batches, self.validate, self.keep, 4, about)

    def loss(self, module, batch):
        step, inputs, wanted = batch
        self.before(step)
        error = (module(inputs) - wanted).square().mean()
        return error, {"half": error.detach() / 2}

    def batches(self, step):
        while True:
            rng = torch.Generator().manual_seed(step)
            inputs = torch.randn(self.size * world(), 4, generator=rng)
            inputs = inputs[rank() * self.size:(rank() + 1) * self.size]
            yield step, inputs, inputs[:, :1] * 2 - inputs[:, 1:2]
            step += 1

    def validate(self, module):
        assert not module.training
        inputs = torch.linspace(-1, 1, 40).view(10, 4)
        with torch.no_grad():
            error = (module(inputs) - inputs[:, :1] * 2 + inputs[:, 1:2]).square().mean()
        return {"score": -error.item()}, {}

    def keep(self, name, module, record):
        state = {k: v.clone() for k, v in module.state_dict().items()}
        self.kept[name] = state, record


def weights(folder: Path) -> dict[str, torch.Tensor]:
    state = torch.load(folder / STATE, weights_only=True)
    return {f"{part}.{name}": value for part in ("module", "average")
            for name, value in state[part].items()}


def same(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def rows(folder: Path, name: str = "log.csv") -> list[dict]:
    with open(folder / name) as stream:
        return [{k: v for k, v in row.items() if k != "seconds"} for row in csv.DictReader(stream)]


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    toy = Toy()
    progress = train(toy.task(), PARAMS, folder)
    assert progress.step == 13 and not progress.stopped
    return folder, toy


def equals(folder: Path, unbroken) -> bool:
    return (same(weights(folder), weights(unbroken[0])) and rows(folder) == rows(unbroken[0])
            and rows(folder, "validation.csv") == rows(unbroken[0], "validation.csv"))


def test_the_same_seed_gives_the_same_run_and_another_one_another(unbroken, tmp_path):
    train(Toy().task(), PARAMS, tmp_path / "again")
    assert equals(tmp_path / "again", unbroken)
    train(Toy().task(), LoopParams(**{**vars(PARAMS), "seed": 4}), tmp_path / "other")
    assert rows(tmp_path / "other") != rows(unbroken[0])


def test_what_is_validated_and_kept_is_the_average_and_the_best(unbroken):
    folder, toy = unbroken
    validated = rows(folder, "validation.csv")
    assert [int(row["step"]) for row in validated] == [4, 8, 12, 13]
    _, record = toy.kept["best"]
    scores = [float(row["score"]) for row in validated]
    assert record["best_step"] == int(validated[scores.index(max(scores))]["step"])
    assert same({f"average.{k}": v for k, v in toy.kept["last"][0].items()},
                {k: v for k, v in weights(folder).items() if k.startswith("average")})
    losses = [float(row["loss"]) for row in rows(folder)]
    assert sum(losses[-4:]) < sum(losses[:4])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("step", [0, 6, 11])
def test_a_stopped_and_resumed_run_equals_an_unbroken_one(unbroken, tmp_path, number, step):
    def stop(now):
        if now == step:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    progress = train(Toy(stop).task(), PARAMS, tmp_path)
    assert (progress.step, progress.stopped) == (step + 1, True)
    assert signal.getsignal(number) is before
    progress = train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert (progress.step, progress.stopped) == (13, False)
    assert equals(tmp_path, unbroken)


def test_a_second_signal_ends_the_run_at_once_and_what_was_saved_stays(unbroken, tmp_path):
    # A shell lets what it starts in the background ignore SIGINT.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def interrupt(now):
        if now == 7:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)

    try:
        with pytest.raises(KeyboardInterrupt):
            train(Toy(interrupt).task(), PARAMS, tmp_path)
    finally:
        signal.signal(signal.SIGINT, before)
    train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert equals(tmp_path, unbroken)


def forked(target, *arguments) -> multiprocessing.Process:
    """A copy of this process, which has torch already, runs target."""
    process = multiprocessing.get_context("fork").Process(target=target, args=arguments)
    process.start()
    return process


def kill_in(step: int):
    def kill(now):
        if now == step:
            os.kill(os.getpid(), signal.SIGKILL)
    return kill


@pytest.mark.parametrize("step", [2, 8, 10])
def test_a_killed_run_loses_one_interval_at_most(unbroken, tmp_path, step):
    process = forked(lambda: train(Toy(kill_in(step)).task(), PARAMS, tmp_path))
    process.join()
    assert process.exitcode == -signal.SIGKILL
    done = 0
    if (tmp_path / STATE).exists():
        done = torch.load(tmp_path / STATE, weights_only=True)["progress"]["step"]
    assert step - PARAMS.save_steps < done <= step
    assert len(rows(tmp_path)) == step  # these are written at once
    train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert equals(tmp_path, unbroken)


def test_a_full_disk_leaves_the_last_good_state(unbroken, tmp_path, monkeypatch):
    saved = []

    def full(descriptor):
        saved.append(descriptor)
        if len(saved) > 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(InputError, match=r"last\.pt: No space left"):
        train(Toy().task(), PARAMS, tmp_path)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.glob(".*")] == []
    assert weights(tmp_path)
    train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert equals(tmp_path, unbroken)


def test_a_run_is_not_overwritten_nor_gone_on_with_otherwise(unbroken, tmp_path):
    folder = tmp_path / "run"
    train(Toy().task(), PARAMS, folder)
    with pytest.raises(InputError, match="--resume"):
        train(Toy().task(), PARAMS, folder)
    with pytest.raises(InputError, match=r"lr 0\.05, not 0\.1"):
        train(Toy().task(), LoopParams(**{**vars(PARAMS), "lr": 0.1}), folder, resume=True)
    with pytest.raises(InputError, match="data None, not 'more'"):
        train(Toy().task(data="more"), PARAMS, folder, resume=True)
    train(Toy().task(), LoopParams(**{**vars(PARAMS), "log_steps": 7}), folder, resume=True)
    assert equals(folder, unbroken)  # finished, so nothing happens
    (folder / STATE).write_bytes((folder / STATE).read_bytes()[:500])
    with pytest.raises(InputError, match="cannot read"):
        train(Toy().task(), PARAMS, folder, resume=True)


def test_what_cannot_change_a_run_may_differ_when_it_is_resumed():
    other = PointPillarsTraining(save_steps=7)
    assert other.decisive() == PointPillarsTraining().decisive()
    assert PointPillarsTraining(version="v0").decisive() != PointPillarsTraining().decisive()


# steps that are not finite

def spoilt(toy: Toy, what: str):
    step, inputs, wanted = next(toy.batches(0))
    if what == "input":
        inputs = inputs.clone()
        inputs[0, 0] = torch.nan
    elif what == "gradient":  # finite itself
        toy.loss = lambda module, batch: ((module(inputs).sum() * 0).abs().sqrt() + 1, {})
    return step, inputs, wanted * (torch.inf if what == "loss" else 1)


@pytest.mark.parametrize("what", ["input", "loss", "gradient"])
def test_a_step_that_is_not_finite_changes_nothing_but_the_count(what):
    toy = Toy()
    run = Run(toy.task(), PARAMS, CPU)
    good = next(toy.batches(1))
    run.step(good)
    before = {**{f"m{k}": v.clone() for k, v in run.module.state_dict().items()},
              **{f"a{k}": v.clone() for k, v in run.average.module.state_dict().items()},
              **{f"o{i}{k}": v.clone() for i, s in run.optimizer.state_dict()["state"].items()
                 for k, v in s.items()}}
    loss, batch = toy.loss, spoilt(toy, what)
    run = _with_loss(run, toy.loss)
    assert run.step(batch) is None
    after = {**{f"m{k}": v for k, v in run.module.state_dict().items()},
             **{f"a{k}": v for k, v in run.average.module.state_dict().items()},
             **{f"o{i}{k}": v for i, s in run.optimizer.state_dict()["state"].items()
                for k, v in s.items()}}
    assert same(before, after)
    assert (run.progress.step, run.progress.skipped, run.progress.in_a_row) == (2, 1, 1)
    run = _with_loss(run, loss)
    assert run.step(good) is not None
    assert (run.progress.skipped, run.progress.in_a_row) == (1, 0)


def _with_loss(run: Run, loss) -> Run:
    run.task = Task(**{**vars(run.task), "loss": loss})
    return run


def test_too_many_of_them_in_a_row_are_an_error(tmp_path):
    class Broken(Toy):
        def batches(self, step):
            for now, inputs, wanted in super().batches(step):
                yield now, inputs, wanted * (torch.nan if now > 2 else 1)

    params = LoopParams(**{**vars(PARAMS), "max_skipped": 4})
    with pytest.raises(InputError, match="in 4 steps in a row, up to step 7"):
        train(Broken().task(), params, tmp_path)


# schedule and average

@few
@given(st.integers(3, 300), st.floats(0.05, 0.95))
def test_the_rate_is_that_of_one_cycle_in_torch(steps, warm):
    parameter = nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.AdamW([parameter], lr=1.0)
    if warm * steps <= 1.01:
        return  # there torch divides by zero
    scheduler = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, 0.01, total_steps=steps, pct_start=warm, div_factor=10)
    for step in range(steps):
        group = optimizer.param_groups[0]
        rate, momentum = one_cycle(step, steps, 0.01, warm)
        assert rate == pytest.approx(group["lr"], rel=1e-6, abs=1e-12)
        assert momentum == pytest.approx(group["betas"][0], rel=1e-6)
        optimizer.step()
        if step + 1 < steps:
            scheduler.step()


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_the_shortest_runs_have_a_rate(steps):
    assert all(0 < one_cycle(i, steps, 0.1, 0.01)[0] <= 0.1 for i in range(steps))


@few
@given(st.lists(st.floats(-10, 10), min_size=1, max_size=30), st.floats(0, 0.99))
def test_the_average_is_the_weighted_sum_of_what_it_saw(values, decay):
    module = nn.Linear(1, 1, bias=False).double()
    average = Average(module, decay)
    shares = []
    for t, value in enumerate(values, 1):
        module.weight.data.fill_(value)
        average.update(module)
        keep = min(decay, t / (t + 9))
        shares = [share * keep for share in shares] + [1 - keep]
    start = 1 - sum(shares)  # what is left of the first weights
    expected = sum(s * v for s, v in zip(shares, values))
    first = average.module.weight.item() - expected
    assert abs(first) <= abs(start) + 1e-9
    if decay == 0:
        assert average.module.weight.item() == values[-1]


def test_an_average_takes_in_the_norms_too():
    module = nn.BatchNorm1d(2)
    average = Average(module, 0.0)
    module.train()(torch.randn(8, 2) + 4)
    average.update(module)
    assert same(average.module.state_dict(), module.state_dict())
    assert not any(p.requires_grad for p in average.module.parameters())


def test_norms_begin_with_the_mean_over_the_steps():
    toy = Toy()
    run, norm = Run(toy.task(), PARAMS, CPU), toy.module[1]
    norm.momentum = 0.0
    run.norms = [(norm, 0.01)]
    seen = []
    toy.module[0].register_forward_hook(lambda *call: seen.append(call[2].mean(dim=0).detach()))
    for batch, _ in zip(toy.batches(0), range(5)):
        run.step(batch)
    assert torch.allclose(norm.running_mean, torch.stack(seen).mean(dim=0), atol=1e-6)


# several processes

def test_two_processes_with_half_the_batch_learn_what_one_learns(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def one_of_two(number):
        os.environ.update(RANK=str(number), LOCAL_RANK=str(number), WORLD_SIZE="2",
                          MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
        with joined(CPU):
            train(Toy(plain=True, size=4).task(), PARAMS, tmp_path / "two", until=1e12)

    crew = [forked(one_of_two, number) for number in range(2)]
    for process in crew:
        process.join()
    assert [process.exitcode for process in crew] == [0, 0]
    train(Toy(plain=True, size=8).task(), PARAMS, tmp_path / "one")
    one, two = weights(tmp_path / "one"), weights(tmp_path / "two")
    assert all(torch.allclose(one[name], two[name], atol=1e-5) for name in one)
    assert [row["step"] for row in rows(tmp_path / "two")] == [
        row["step"] for row in rows(tmp_path / "one")]


def test_without_torchrun_there_is_one_process():
    with joined(CPU) as device:
        assert (device, rank(), world()) == (CPU, 0, 1)


# time that is over

def test_a_run_out_of_time_validates_keeps_and_goes_on_when_it_is_resumed(unbroken, tmp_path,
                                                                          monkeypatch):
    now = [0.0]
    monkeypatch.setattr(loop.time, "monotonic", lambda: now[0])
    toy = Toy(lambda step: now.__setitem__(0, float(step)))
    progress = train(toy.task(), PARAMS, tmp_path, until=5.0)
    assert (progress.step, progress.late, progress.stopped) == (6, True, False)
    assert [int(row["step"]) for row in rows(tmp_path, "validation.csv")] == [4, 6]
    assert set(toy.kept) == {"best", "last"}
    progress = train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert (progress.step, progress.late) == (13, False)
    assert same(weights(tmp_path), weights(unbroken[0])) and rows(tmp_path) == rows(unbroken[0])


PLANNED = LoopParams(**{**vars(PARAMS), "steps": 300, "validate_steps": 60, "save_steps": 300})


def timed(seconds, validation: float, folder: Path, monkeypatch, **others) -> tuple[Toy, Progress]:
    """A run of PLANNED with steps of seconds(step) on a clock of its own."""
    now = [0.0]
    monkeypatch.setattr(loop.time, "monotonic", lambda: now[0])
    toy = Toy(lambda step: now.__setitem__(0, now[0] + seconds(step)))
    validate = toy.validate

    def slowly(module):
        now[0] += validation
        return validate(module)
    toy.validate = slowly
    return toy, train(toy.task(), PLANNED, folder, validation=validation, **others)


@pytest.fixture(scope="module")
def planned(tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned")
    train(Toy().task(), PLANNED, folder)
    return folder


@pytest.mark.parametrize("fits", [0.2, 0.5, 0.8])
@pytest.mark.parametrize("seconds", [lambda _: 10.0, lambda step: 4.0 if step < 50 else 12.0,
                                     lambda step: 6.0 + 6.0 * (step % 7)])
def test_a_run_that_is_slower_than_planned_ends_in_time_with_the_rate_of_the_end(
        seconds, fits, planned, tmp_path, monkeypatch, capsys):
    first = int(fits * 300)
    until = sum(seconds(step) for step in range(first)) + 30.0 * (first // 60 + 1)
    toy, progress = timed(seconds, 30.0, tmp_path, monkeypatch, until=until)
    assert not progress.late and loop.time.monotonic() <= until
    assert 0.85 * first <= progress.step <= first
    assert 300 <= progress.step + progress.left_out < 301
    assert capsys.readouterr().err.count("steps fit into the budget") == 1
    rates, whole = ([float(row["lr"]) for row in rows(folder)] for folder in (tmp_path, planned))
    assert rates[-1] == whole[-1] and max(rates) > 0.95 * max(whole)
    jumps, slope = (max(abs(a - b) for a, b in pairwise(each)) for each in (rates, whole))
    assert jumps < 3 * slope / fits  # no cliff
    assert set(toy.kept) == {"best", "last"}


def test_with_time_enough_a_budget_changes_nothing(planned, tmp_path, monkeypatch):
    _, progress = timed(lambda _: 1.0, 30.0, tmp_path, monkeypatch, until=600.0)
    assert progress.left_out == 0 and equals(tmp_path, (planned,))


def test_a_shortened_run_that_is_stopped_is_resumed_where_it_was(tmp_path, monkeypatch):
    def stop(step):
        if step == 40:
            signal.raise_signal(signal.SIGTERM)
        return 10.0
    _, before = timed(stop, 0.0, tmp_path, monkeypatch, until=1500.0)
    assert before.stopped and before.left_out > 10
    progress = train(Toy().task(), PLANNED, tmp_path, resume=True)
    rates = [float(row["lr"]) for row in rows(tmp_path)]
    assert progress.left_out == pytest.approx(before.left_out, abs=1)
    assert rates[-1] < 1e-3 * PLANNED.lr and progress.step + progress.left_out >= 300
    assert max(abs(a - b) for a, b in pairwise(rates[45:])) < 0.02 * PLANNED.lr
