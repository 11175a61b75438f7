"""Laws of the training loop: what a stop, a kill, a full disk or a NaN may change, and what not."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import socket
from itertools import islice

import pytest
import torch
from training_toy import PARAMS, Toy, equals, rows, same, weights

from lidar_perception.runs import files
from lidar_perception.training import loop
from lidar_perception.training.loop import train
from lidar_perception.training.out import STATE
from lidar_perception.training.params import LoopParams, PointPillarsTraining
from lidar_perception.training.ranks import joined, rank, world
from lidar_perception.training.run import Run, Task
from lidar_perception.types import InputError

pytestmark = pytest.mark.usefixtures("one_thread_for_all")
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    toy = Toy()
    progress = train(toy.task(), PARAMS, folder)
    assert progress.step == 13 and not progress.stopped
    return folder, toy


def test_the_same_seed_gives_the_same_run_and_another_one_another(unbroken, tmp_path):
    train(Toy().task(), PARAMS, tmp_path / "again")
    assert equals(tmp_path / "again", unbroken[0])
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
    assert equals(tmp_path, unbroken[0])


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
    assert equals(tmp_path, unbroken[0])


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
    assert equals(tmp_path, unbroken[0])


def test_where_a_process_that_prepares_batches_dies_what_was_learned_is_kept(unbroken, tmp_path):
    class Short(Toy):
        def batches(self, step):
            yield from islice(super().batches(step), 5)
            raise InputError("a process ended")

    with pytest.raises(InputError, match="a process ended"):
        train(Short().task(), PARAMS, tmp_path)
    assert torch.load(tmp_path / STATE, weights_only=True)["progress"]["step"] == 5
    train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert equals(tmp_path, unbroken[0])


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
    assert equals(tmp_path, unbroken[0])


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
    assert equals(folder, unbroken[0])  # finished, so nothing happens
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
