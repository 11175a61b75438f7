"""The training loop with interruptions, kills, full disks, NaN values and time limits."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import socket
from itertools import islice

import pytest
import torch
from training_toy import PARAMS, Toy, are_equal, are_equal_runs, read_rows, weights

from lidar_perception.runs import files
from lidar_perception.training import loop
from lidar_perception.training.distributed import get_rank, get_world_size, join_process_group
from lidar_perception.training.loop import train
from lidar_perception.training.params import LoopParams, PointPillarsTraining
from lidar_perception.training.run import Run, Task
from lidar_perception.training.run_directory import STATE
from lidar_perception.types import InputError

pytestmark = pytest.mark.usefixtures("one_thread_for_all")
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def uninterrupted_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unbroken")
    toy = Toy()
    progress = train(toy.task(), PARAMS, folder)
    assert progress.step == 13 and not progress.stopped
    return folder, toy


def test_seed_determines_the_run(uninterrupted_run, tmp_path):
    train(Toy().task(), PARAMS, tmp_path / "again")
    assert are_equal_runs(tmp_path / "again", uninterrupted_run[0])
    train(Toy().task(), LoopParams(**{**vars(PARAMS), "seed": 4}), tmp_path / "other")
    assert read_rows(tmp_path / "other") != read_rows(uninterrupted_run[0])


def test_averaged_weights_are_validated_and_best_are_saved(uninterrupted_run):
    folder, toy = uninterrupted_run
    validated = read_rows(folder, "validation.csv")
    assert [int(row["step"]) for row in validated] == [4, 8, 12, 13]
    _, record = toy.saved["best"]
    scores = [float(row["score"]) for row in validated]
    assert record["best_step"] == int(validated[scores.index(max(scores))]["step"])
    assert are_equal(
        {f"average.{k}": v for k, v in toy.saved["last"][0].items()},
        {k: v for k, v in weights(folder).items() if k.startswith("average")},
    )
    losses = [float(row["loss"]) for row in read_rows(folder)]
    assert sum(losses[-4:]) < sum(losses[:4])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("step", [0, 6, 11])
def test_stopped_and_resumed_run_equals_uninterrupted_run(uninterrupted_run, tmp_path, number, step):
    def stop(now):
        if now == step:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    progress = train(Toy(stop).task(), PARAMS, tmp_path)
    assert (progress.step, progress.stopped) == (step + 1, True)
    assert signal.getsignal(number) is before
    progress = train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert (progress.step, progress.stopped) == (13, False)
    assert are_equal_runs(tmp_path, uninterrupted_run[0])


def test_second_signal_ends_run_and_keeps_saved_state(uninterrupted_run, tmp_path):
    # Background processes of a shell ignore SIGINT.
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
    assert are_equal_runs(tmp_path, uninterrupted_run[0])


def fork(target, *arguments) -> multiprocessing.Process:
    """Run target in a fork of this process, where torch is already imported."""
    process = multiprocessing.get_context("fork").Process(target=target, args=arguments)
    process.start()
    return process


def make_killer(step: int):
    def kill(now):
        if now == step:
            os.kill(os.getpid(), signal.SIGKILL)

    return kill


@pytest.mark.parametrize("step", [2, 8, 10])
def test_killed_run_loses_at_most_one_save_interval(uninterrupted_run, tmp_path, step):
    process = fork(lambda: train(Toy(make_killer(step)).task(), PARAMS, tmp_path))
    process.join()
    assert process.exitcode == -signal.SIGKILL
    done = 0
    if (tmp_path / STATE).exists():
        done = torch.load(tmp_path / STATE, weights_only=True)["progress"]["step"]
    assert step - PARAMS.save_steps < done <= step
    assert len(read_rows(tmp_path)) == step  # rows are flushed
    train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert are_equal_runs(tmp_path, uninterrupted_run[0])


def test_state_is_saved_if_loading_samples_fails(uninterrupted_run, tmp_path):
    class Short(Toy):
        def batches(self, step):
            yield from islice(super().batches(step), 5)
            raise InputError("a process ended")

    with pytest.raises(InputError, match="a process ended"):
        train(Short().task(), PARAMS, tmp_path)
    assert torch.load(tmp_path / STATE, weights_only=True)["progress"]["step"] == 5
    train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert are_equal_runs(tmp_path, uninterrupted_run[0])


def test_full_disk_leaves_last_good_state(uninterrupted_run, tmp_path, monkeypatch):
    descriptors = []

    def full(descriptor):
        descriptors.append(descriptor)
        if len(descriptors) > 3:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(InputError, match=r"last\.pt: No space left"):
        train(Toy().task(), PARAMS, tmp_path)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.glob(".*")] == []
    assert weights(tmp_path)
    train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert are_equal_runs(tmp_path, uninterrupted_run[0])


def test_run_is_not_overwritten_or_resumed_with_other_settings(uninterrupted_run, tmp_path):
    folder = tmp_path / "run"
    train(Toy().task(), PARAMS, folder)
    with pytest.raises(InputError, match="--resume"):
        train(Toy().task(), PARAMS, folder)
    with pytest.raises(InputError, match=r"lr 0\.05, not 0\.1"):
        train(Toy().task(), LoopParams(**{**vars(PARAMS), "lr": 0.1}), folder, resume=True)
    with pytest.raises(InputError, match="data None, not 'more'"):
        train(Toy().task(data="more"), PARAMS, folder, resume=True)
    train(Toy().task(), LoopParams(**{**vars(PARAMS), "log_steps": 7}), folder, resume=True)
    assert are_equal_runs(folder, uninterrupted_run[0])  # already finished, so nothing happens
    (folder / STATE).write_bytes((folder / STATE).read_bytes()[:500])
    with pytest.raises(InputError, match="cannot read"):
        train(Toy().task(), PARAMS, folder, resume=True)


def test_settings_without_effect_may_differ_when_resuming():
    settings = PointPillarsTraining().get_fixed_settings()
    assert PointPillarsTraining(save_steps=7).get_fixed_settings() == settings
    assert PointPillarsTraining(version="v0").get_fixed_settings() != settings


# non-finite steps


def spoil_batch(toy: Toy, part: str):
    step, inputs, target = next(toy.batches(0))
    if part == "input":
        inputs = inputs.clone()
        inputs[0, 0] = torch.nan
    elif part == "gradient":  # the loss itself is finite
        toy.loss = lambda module, batch: ((module(inputs).sum() * 0).abs().sqrt() + 1, {})
    return step, inputs, target * (torch.inf if part == "loss" else 1)


@pytest.mark.parametrize("part", ["input", "loss", "gradient"])
def test_nonfinite_step_changes_only_counters(part):
    toy = Toy()
    run = Run(toy.task(), PARAMS, CPU)
    good = next(toy.batches(1))
    run.step(good)
    before = {
        **{f"m{k}": v.clone() for k, v in run.module.state_dict().items()},
        **{f"a{k}": v.clone() for k, v in run.average.module.state_dict().items()},
        **{f"o{i}{k}": v.clone() for i, s in run.optimizer.state_dict()["state"].items() for k, v in s.items()},
    }
    loss, batch = toy.loss, spoil_batch(toy, part)
    run = _with_loss(run, toy.loss)
    assert run.step(batch) is None
    after = {
        **{f"m{k}": v for k, v in run.module.state_dict().items()},
        **{f"a{k}": v for k, v in run.average.module.state_dict().items()},
        **{f"o{i}{k}": v for i, s in run.optimizer.state_dict()["state"].items() for k, v in s.items()},
    }
    assert are_equal(before, after)
    assert (run.progress.step, run.progress.skipped, run.progress.in_a_row) == (2, 1, 1)
    run = _with_loss(run, loss)
    assert run.step(good) is not None
    assert (run.progress.skipped, run.progress.in_a_row) == (1, 0)


def _with_loss(run: Run, loss) -> Run:
    run.task = Task(**{**vars(run.task), "loss": loss})
    return run


def test_too_many_nonfinite_steps_are_an_error(tmp_path):
    class Broken(Toy):
        def batches(self, step):
            for now, inputs, target in super().batches(step):
                yield now, inputs, target * (torch.nan if now > 2 else 1)

    params = LoopParams(**{**vars(PARAMS), "max_skipped": 4})
    with pytest.raises(InputError, match="in 4 consecutive steps, up to step 7"):
        train(Broken().task(), params, tmp_path)


# several processes


def test_two_processes_with_half_batch_equal_one(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]

    def train_rank(number):
        os.environ.update(
            RANK=str(number), LOCAL_RANK=str(number), WORLD_SIZE="2", MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port)
        )
        with join_process_group(CPU):
            train(Toy(plain=True, size=4).task(), PARAMS, tmp_path / "two", deadline=1e12)

    processes = [fork(train_rank, number) for number in range(2)]
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0]
    train(Toy(plain=True, size=8).task(), PARAMS, tmp_path / "one")
    one, two = weights(tmp_path / "one"), weights(tmp_path / "two")
    assert all(torch.allclose(one[name], two[name], atol=1e-5) for name in one)
    assert [row["step"] for row in read_rows(tmp_path / "two")] == [row["step"] for row in read_rows(tmp_path / "one")]


def test_training_without_torchrun_is_one_process():
    with join_process_group(CPU) as device:
        assert (device, get_rank(), get_world_size()) == (CPU, 0, 1)


# time limit


def test_run_out_of_time_validates_saves_and_resumes(uninterrupted_run, tmp_path, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(loop.time, "monotonic", lambda: now[0])
    toy = Toy(lambda step: now.__setitem__(0, float(step)))
    progress = train(toy.task(), PARAMS, tmp_path, deadline=5.0)
    assert (progress.step, progress.late, progress.stopped) == (6, True, False)
    assert [int(row["step"]) for row in read_rows(tmp_path, "validation.csv")] == [4, 6]
    assert set(toy.saved) == {"best", "last"}
    progress = train(Toy().task(), PARAMS, tmp_path, resume=True)
    assert (progress.step, progress.late) == (13, False)
    assert are_equal(weights(tmp_path), weights(uninterrupted_run[0])) and read_rows(tmp_path) == read_rows(
        uninterrupted_run[0]
    )
