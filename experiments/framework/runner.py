"""Running of an experiment over the frames of a recording, in several processes or on a cluster."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from experiments.framework.experiment import Experiment
from experiments.framework.report_files import list_report_files
from experiments.framework.trained_models import ModelRequest, plan_training, train_models
from lidar_perception import __version__
from lidar_perception.candidates.warm_up import warm_up
from lidar_perception.data.frame import Frame, Recording
from lidar_perception.runs.journal import Journal, open_journal
from lidar_perception.runs.resuming import hash_names
from lidar_perception.scoring.run import fill_journal


def run_experiment(
    experiment: Experiment,
    recording: Recording,
    out: Path,
    *,
    jobs: int = 1,
    dask: str | None = None,
    force: bool = False,
    limit: int | None = None,
) -> list[dict[str, Any]]:
    """Measure the frames of a recording, or the first `limit` ones, and return their records in order.

    Every record is written to out/frames.jsonl as soon as it is measured, so that an interrupted run
    can be resumed. Apart from measured times, the records do not depend on jobs or dask.

    Args:
        jobs, dask: See scoring.run.results.
        force: True to delete the records of another run in `out`.

    Returns:
        One record for each frame. A frame that cannot be measured has the record {"frame": name,
        "skipped": reason}. Labels without a scan come last.

    Raises:
        InputError: `out` contains another run, or a process or the cluster fails.
    """
    with _open_run(experiment, recording, out, force) as journal:
        return _measure(experiment, recording, journal, jobs, dask, limit)


def run_with_models(
    experiment: Experiment,
    request: ModelRequest,
    recording: Recording,
    *,
    dask: str | None = None,
    force: bool = False,
    limit: int | None = None,
) -> tuple[Experiment, list[dict[str, Any]]]:
    """Train the models of an experiment, then measure frames like run_experiment().

    Models already trained in request.out with the same configuration are reused, even with `force`.

    Returns:
        The experiment with its models, and the records.

    Raises:
        InputError: See run_experiment, plan_training and train_models.
        KeyboardInterrupt: The training was stopped.
    """
    with _open_run(experiment, recording, request.out, force, request.collect_settings()) as journal:
        trained_experiment = experiment.with_models(train_models(request, plan_training(request)))
        return trained_experiment, _measure(trained_experiment, recording, journal, request.jobs, dask, limit)


@contextmanager
def _open_run(
    experiment: Experiment, recording: Recording, out: Path, force: bool, training: dict[str, Any] | None = None
) -> Iterator[Journal]:
    """Open the journal of the run in `out`, see run_experiment."""
    names = [frame.name for frame in recording]
    path = recording.path.resolve() if recording.path.exists() else recording.path  # a simulated data set has no path
    plan = {
        "experiment": experiment.name,
        "version": __version__,
        "data": str(path),
        "frames": len(names),
        "frame_names": hash_names(names),
        "settings": experiment.settings,
        **({} if training is None else {"training": training}),
    }
    with open_journal(out, plan, force=force, list_files=list_report_files) as journal:
        yield journal


def _measure(
    experiment: Experiment, recording: Recording, journal: Journal, jobs: int, dask: str | None, limit: int | None
) -> list[dict[str, Any]]:
    """Measure the frames that are not yet in the journal, and return all records, see run_experiment."""
    names = [frame.name for frame in recording]
    with threadpool_limits(1):
        fill_journal(
            journal,
            recording,
            functools.partial(_make_measure, experiment),
            names[:limit],
            jobs=jobs,
            dask=dask,
            title=experiment.name,
        )
    journal.sort(names)
    records = [json.loads(journal.lines[name]) for name in names[:limit]]
    missing_scans = recording.missing_scans if limit is None else ()
    return records + [{"frame": name, "skipped": reason} for name, reason in missing_scans]


def _make_measure(experiment: Experiment, recording: Recording) -> Callable[[Frame], str]:
    """Return a function that measures a frame and returns its record as JSON."""
    if not experiment.has_models:  # trained detectors warm up when opened
        warm_up()
    frame_numbers = {frame.name: i for i, frame in enumerate(recording)}

    def measure(frame: Frame) -> str:
        record = experiment.measure(recording.frames, frame_numbers[frame.name])
        return json.dumps({"frame": frame.name, **record}, allow_nan=False)

    return measure
