"""An experiment over all frames of a KITTI folder, in many processes here or on many machines."""

from __future__ import annotations

import functools
import hashlib
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import closing
from itertools import islice
from pathlib import Path
from typing import Any
from uuid import uuid4

from threadpoolctl import threadpool_limits

from lidar_perception import __version__
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.kitti.folder import KittiFrame, labels_without_scan, open_kitti
from lidar_perception.reproduction.experiment import Experiment
from lidar_perception.reproduction.journal import journal
from lidar_perception.runs.processes import in_processes
from lidar_perception.runs.terminal import track
from lidar_perception.types import InputError

CONNECT_S = 20.0  # for a Dask scheduler to answer and a first worker to come
AHEAD = 2         # futures in flight for each thread of a Dask cluster


def run(experiment: Experiment, kitti: Path, out: Path, *, jobs: int = 1, dask: str | None = None,
        force: bool = False, limit: int | None = None) -> list[dict[str, Any]]:
    """The records of the first `limit` frames, or of all, in their order. A frame that cannot be
    measured has {"frame": name, "skipped": why}; those whose labels have no scan come last.

    Every finished frame is kept in out/frames.jsonl at once; what a run that was stopped has kept
    is not measured again. jobs processes measure, or with dask the workers of the cluster whose
    scheduler has that address; they need this package and see the KITTI folder under the same
    path. The records do not depend on either, apart from times in them.

    InputError if the folder cannot be read, if out holds something else (see journal()) or if a
    process or a cluster fails.
    """
    frames = open_kitti(kitti)
    names = [frame.name for frame in frames]
    plan = {"experiment": experiment.name, "version": __version__,
            "kitti": str(Path(kitti).resolve()), "frames": len(names),
            "frame_names": hashlib.sha256("\n".join(names).encode()).hexdigest()[:12],
            "settings": experiment.settings}
    with journal(out, plan, force=force) as done:
        missing = [i for i, name in enumerate(names[:limit]) if name not in done.lines]
        if dask:
            lines = _on_dask(dask, experiment, kitti, missing)
        else:
            lines = in_processes(functools.partial(_measurer, experiment, kitti), missing, jobs,
                                 "measured frames")
        with threadpool_limits(1), closing(lines):
            for line in track(lines, experiment.name, len(missing)):
                done.add(line)
        done.sort(names)
        records = [json.loads(done.lines[name]) for name in names[:limit]]
    lost = labels_without_scan(kitti) if limit is None else []
    return records + [{"frame": label.stem, "skipped": f"{label} has no scan; download it again"}
                      for label in lost]


def _measurer(experiment: Experiment, kitti: Path) -> Callable[[int], str]:
    """What takes the number of a frame to its record as JSON, made in the process that will use
    it: frames cannot be sent to another."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # for libraries that are loaded later
    threadpool_limits(1)
    return functools.partial(_record, experiment, _open(kitti))


def _open(kitti: Path, run: str = "") -> list[KittiFrame]:
    warm_up()
    return open_kitti(kitti)


def _record(experiment: Experiment, frames: list[KittiFrame], number: int) -> str:
    name = frames[number].name
    try:
        return json.dumps({"frame": name, **experiment.measure(frames, number)}, allow_nan=False)
    except InputError as error:
        return json.dumps({"frame": name, "skipped": str(error)})
    except Exception as error:
        error.add_note(f"while frame {name} was measured")
        raise


def _on_dask(address: str, experiment: Experiment, kitti: Path,
             numbers: list[int]) -> Iterator[str]:
    """The records of these frames, as the workers of a Dask cluster finish them."""
    try:
        import distributed
        from distributed.comm import CommClosedError
    except ImportError:
        raise InputError("--dask needs the package distributed; pip install "
                         "'lidar_perception[distributed]'") from None
    work = functools.partial(_record_here, experiment, Path(kitti).resolve(), uuid4().hex)
    try:
        client = distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
        client.wait_for_workers(1, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise InputError(f"cannot reach a Dask scheduler with workers at {address}: "
                         f"{str(error) or repr(error)}") from None
    with client:
        ahead = AHEAD * sum(client.nthreads().values())
        waiting = iter(numbers)
        running = distributed.as_completed(client.map(work, [*islice(waiting, ahead)], pure=False),
                                           loop=client.loop)
        try:
            for future in running:
                yield future.result()
                for number in islice(waiting, 1):
                    running.add(client.submit(work, number, pure=False))
        except (distributed.KilledWorker, CommClosedError, CancelledError) as error:
            raise InputError(f"the Dask cluster at {address} failed: {error}; finished frames "
                             "are kept, the same command resumes the run") from None


_kept_open = functools.lru_cache(maxsize=1)(_open)


def _record_here(experiment: Experiment, kitti: Path, run: str, number: int) -> str:
    """As _record, in a process that may serve other runs before and after."""
    with threadpool_limits(1):
        return _record(experiment, _kept_open(kitti, run), number)
