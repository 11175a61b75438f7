"""Simulated scans as data sets of other layouts, written by many processes.

Every frame is made from its number alone, so that neither the number of processes nor a stop in
between changes a byte.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from pathlib import Path

import numpy as np

from lidar_perception.datasets import write_kitti, write_semantickitti
from lidar_perception.simulation.camera import FORWARD_CAMERA, kitti_labels
from lidar_perception.simulation.drive import SimulatedScan, longest_drive, scan_at
from lidar_perception.simulation.folder import finish_frame
from lidar_perception.simulation.scene import ANY, Streets
from lidar_perception.simulation.sensor import Sensor
from lidar_perception.types import InputError

LAYOUTS = ("kitti", "kitti-tracking", "semantickitti")


@dataclass(frozen=True)
class Plan:
    """frames scans, streets_of of each of the streets seed, seed + 1, ..., in one of LAYOUTS.
    InputError for numbers that cannot be."""

    layout: str
    sensor: Sensor
    seed: int
    frames: int
    streets_of: int
    streets: Streets = ANY

    def __post_init__(self) -> None:
        most = longest_drive(self.sensor)
        for wrong, what in (
                (self.layout not in ("mcap", *LAYOUTS), f"layout = {self.layout!r} must be one of "
                                             f"{', '.join(LAYOUTS)}"),
                (self.frames < 1, f"frames = {self.frames} must be at least 1"),
                (self.seed < 0, f"seed = {self.seed} must not be negative"),
                (not 1 <= self.streets_of <= most,
                 f"streets of {self.streets_of} scans cannot be: 1 .. {most} fit into the time of "
                 "one street")):
            if wrong:
                raise InputError(what)


def write_frame(folder: Path, plan: Plan, number: int) -> None:
    """Simulate and write frame number, all of its files. InputError where one cannot be
    written."""
    sequence, moment = divmod(number, plan.streets_of)
    scan = scan_at(plan.seed + sequence, moment, plan.sensor, plan.streets)
    order = np.argsort(scan.ring, kind="stable")  # as in KITTI's files, beam after beam
    cloud = np.column_stack([scan.frame.xyz, scan.frame.intensity])[order]
    if plan.layout == "semantickitti":
        shares = _semantic(folder, plan, sequence, moment, scan, cloud, order)
    else:
        truth = kitti_labels(scan.truth)
        if plan.layout == "kitti":
            write_kitti.write_object(folder, number, cloud, truth, FORWARD_CAMERA)
            shares = {}
        else:
            name = f"{sequence:04}"
            write_kitti.write_velodyne(folder / f"training/velodyne/{name}/{moment:06}.bin", cloud)
            shares = {f"training/label_02/{name}.txt":
                      write_kitti.tracking_label_text(moment, truth, FORWARD_CAMERA)}
            if moment == 0:
                shares[f"training/calib/{name}.txt"] = write_kitti.calibration_text(FORWARD_CAMERA)
    finish_frame(folder, number, shares)


def _semantic(folder: Path, plan: Plan, sequence: int, moment: int, scan: SimulatedScan,
              cloud: np.ndarray, order: np.ndarray) -> dict[str, str]:
    digits = max(2, len(str((plan.frames - 1) // plan.streets_of)))
    name = f"sequences/{sequence:0{digits}}"
    write_semantickitti.write_scan(folder / name, moment, cloud, scan.semantic[order],
                                   scan.instance[order])
    shares = {f"{name}/poses.txt": write_semantickitti.pose_line(scan.pose, FORWARD_CAMERA),
              f"{name}/times.txt": f"{moment / plan.sensor.rate:.6e}\n"}
    if moment == 0:
        shares[f"{name}/calib.txt"] = write_semantickitti.calibration_text(FORWARD_CAMERA)
    return shares


def write_frames(folder: Path, plan: Plan, numbers: list[int], jobs: int) -> Iterator[int]:
    """Write the frames of these numbers with so many processes; yields each when it is there.
    InputError, and the end of all processes, where one fails; they end with the iterator too."""
    if min(jobs, len(numbers)) <= 1:
        for number in numbers:
            write_frame(folder, plan, number)
            yield number
        return
    context = multiprocessing.get_context("spawn")
    running: dict[Connection, multiprocessing.process.BaseProcess] = {}
    try:
        for j in range(min(jobs, len(numbers))):
            receiver, sender = context.Pipe(duplex=False)
            process = context.Process(target=_work, daemon=True,
                                      args=(folder, plan, numbers[j::jobs], sender))
            with _without_interrupts():
                process.start()
            sender.close()
            running[receiver] = process
        while running:
            for receiver in wait(list(running)):
                yield from _receive(receiver, running)
    finally:
        for process in running.values():
            process.terminate()
        for process in running.values():
            process.join()


def _receive(receiver: Connection, running: dict) -> Iterator[int]:
    try:
        done = receiver.recv()
    except EOFError:
        process = running.pop(receiver)
        process.join()
        if process.exitcode:
            raise InputError(f"a process that wrote frames ended with exit code {process.exitcode}"
                             + (", perhaps for want of memory: try fewer --jobs"
                                if process.exitcode == -signal.SIGKILL else "")) from None
        return
    if isinstance(done, str):
        raise InputError(done)
    yield done


def _work(folder: Path, plan: Plan, numbers: list[int], sender: Connection) -> None:
    parent = multiprocessing.parent_process()
    with suppress(BrokenPipeError):  # nobody is there any more
        for number in numbers:
            if parent is not None and not parent.is_alive():
                return
            try:
                write_frame(folder, plan, number)
            except InputError as error:
                sender.send(str(error))
                return
            sender.send(number)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """What is started in here never sees ctrl-C: the process that started it ends it."""
    resource_tracker.ensure_running()  # or it would be started below, and lift the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
