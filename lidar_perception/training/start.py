"""From what is asked for to a run: measure the machine, plan, say so, prepare, train."""

from __future__ import annotations

import json
import math
import shutil
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from hashlib import sha256
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple, Protocol

import torch

from lidar_perception.detectors.checkpoint import HEIGHT_APART, network_of
from lidar_perception.detectors.devices import chosen_device
from lidar_perception.param_fields import with_values
from lidar_perception.runs.files import make_folder, read_text, write_text
from lidar_perception.runs.machine import cores
from lidar_perception.runs.resuming import differences, digest
from lidar_perception.runs.terminal import duration, errors
from lidar_perception.simulation.sensor import Sensor, sensor_named
from lidar_perception.training.asked import Asked
from lidar_perception.training.data import Batches, Item, ReadScenes, Stream
from lidar_perception.training.loop import train
from lidar_perception.training.measuring import MOST
from lidar_perception.training.out import RUN, SCANS, STATE, alone, may_hold
from lidar_perception.training.plan import (
    STARTING,
    Data,
    Plan,
    Speed,
    plan,
    preparing,
    refitted,
    training,
    validation,
)
from lidar_perception.training.preparing import keep_all
from lidar_perception.training.ranks import joined, rank, wait, world
from lidar_perception.training.run import Progress, Task
from lidar_perception.training.scenes import RecordedScenes, SimulatedScenes
from lidar_perception.training.sources import about_data, training_scenes
from lidar_perception.types import InputError

BUDGET = 2.0      # hours
PACKAGE = Path("package")  # in --init: the weights that come with the package
ROOM = 0.5        # GB that stay free on the disk


class Network(Protocol):
    """The parts of a training that depend on the network; params may be planned or not."""

    @property
    def name(self) -> str:
        """What is trained, for people."""

    @property
    def cutting(self) -> str:
        """What is cut from the scenes before the training, for people."""

    def most_cuts(self, params: Any) -> int:
        """Scenes that are cut at most."""

    def part(self, params: Any) -> dict[str, Any]:
        """The parameters that train on a part of the range, which is quicker; none if there is no
        such choice."""

    def measured(self, params: Any, scenes: Iterable[Item], held_out: Sequence[Any],
                 device: torch.device) -> tuple[float, float, float, float]:
        """Seconds to cut a scene, of a step on the part and on the whole of the range, without the
        preparation's share of other cores, and to validate a frame; with the first scenes that can
        be used. InputError where none can."""

    def own_weights(self, params: Any) -> Path:
        """Those that come with the package. InputError if there are none."""

    def cut(self, params: Any, sources: Sequence[Any], held_out: Sequence[Any],
            cache: Path) -> tuple[list[Any], list[Sequence[int]]]:
        """Sources of what is cut, and the numbers of each that are."""

    def gather(self, params: Any, cut: tuple[list[Any], list], out: Path) -> None:
        """Write into out what is made of all that was cut."""

    def scenes(self, params: Any, sources: Sequence[Any], held_out: Sequence[Any],
               cut: tuple[list[Any], list], out: Path) -> tuple[Stream, ReadScenes]:
        """What is learned from, and what is validated on."""

    def task(self, params: Any, batches: Batches, held_out: ReadScenes, out: Path,
             device: torch.device, about: dict[str, Any], commit: str, init: Path | None) -> Task:
        """The task of the loop."""


class Ended(NamedTuple):
    """How a run ended, of so many steps, and what it was fed with."""

    progress: Progress
    steps: int
    batches: Batches


def _begins_with(network: Network, asked: Asked, params: Any) -> Path | None:
    """The file of --init, if there is one."""
    return network.own_weights(params) if asked.init == PACKAGE else asked.init


def _check(asked: Asked, init: Path | None) -> None:
    """InputError, before anything is made, for what cannot be."""
    if asked.budget is not None and not 0 < asked.budget < math.inf:
        raise InputError(f"--budget {asked.budget:g} must be a number of hours above 0")
    if init is not None:
        network_of(init)
    may_hold(asked.out, asked.resume)


def _scenes_of(asked: Asked, params: Any, sensor: Sensor) -> tuple[tuple, tuple]:
    """Return the sources to train on and those to validate on."""
    around = getattr(params, "range", "") == "around"
    return training_scenes(asked.data, asked.val, asked.split, asked.val_split, params.data,
                           params.seed, sensor, around, params.scene, params.mount_height)


def start(network: Network, asked: Asked, params: Any, commit: str = "") -> Ended | None:
    """Train a network; how it ended, None in all but the first of several processes.

    The first start measures this machine, plans and writes the plan to RUN; a resumed run keeps
    it. All that is prepared is kept in the cache, so that a run may be killed at any time.
    InputError for what cannot be used, before much is computed.
    """
    begun = time.monotonic()
    init = _begins_with(network, asked, params)
    _check(asked, init)
    if not params.data.cache:
        params = with_values(params, {"data.cache": str(asked.out / SCANS)})
    decided = bool(params.steps or params.epochs)
    hours = asked.budget if decided else asked.budget or BUDGET
    sensor = sensor_named(params.sensor, params.mount_height)
    settings = _settings_of(asked, params, sensor, init)
    with joined(chosen_device(asked.device)) as device, alone(asked.out):
        wait()  # until all have looked at what rank 0 is going to write
        given, params = params, _make_plan(network, asked, params, settings, sensor, device)
        sources, held_out = _scenes_of(asked, params, sensor)
        cut = network.cut(params, sources, held_out, Path(params.data.cache))
        if rank() == 0:
            with _said_when_stopped():
                _prepare(network, asked, sources, held_out, cut)
                network.gather(params, cut, asked.out)
                if not decided:
                    _refit(network, asked, given, sensor, device, begun, hours or BUDGET)
        wait()
        params = _settled(network, asked, given, settings)
        stream, to_validate = network.scenes(params, sources, held_out, cut, asked.out)
        batches = Batches(stream, params.batch, asked.jobs, rank(), world())
        about = {**about_data(asked.data, asked.val, stream, held_out, asked.init),
                 "sensor": _about_sensor(params, sensor, sources)}
        task = network.task(params, batches, to_validate, asked.out, device, about, commit,
                            init)
        until = math.inf if hours is None else begun + 3600 * hours
        progress = train(task, params, asked.out, device, asked.resume, until,
                         validation(*_planned(asked)))
        return Ended(progress, params.steps, batches) if rank() == 0 else None


@contextmanager
def _said_when_stopped() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        errors.print("stopped; what is prepared is kept, --resume goes on")
        raise


def _make_plan(network: Network, asked: Asked, params: Any, settings: dict[str, Any],
            sensor: Sensor, device: torch.device) -> Any:
    """params with the plan of the first start, which may be this one. InputError where that had
    other settings."""
    if rank() == 0:
        make_folder(Path(params.data.cache))
        with _said_when_stopped():
            _settle(network, asked, params, settings, sensor, device)
    wait()
    return _settled(network, asked, params, settings)


def _settle(network: Network, asked: Asked, params: Any, settings: dict[str, Any], sensor: Sensor,
            device: torch.device) -> None:
    """Plan, say so and write it, unless that was done by an earlier start."""
    path = asked.out / RUN
    if path.is_file():
        errors.print(f"resuming {asked.out}")
        return
    errors.print("measuring this machine with a few scenes ...")
    speed, sources, held_out = _measured(network, asked, params, sensor, device)
    data = Data(_simulated(sources), _simulated(held_out), _recorded(sources), _recorded(held_out),
                params.batch * world(), network.most_cuts(params))
    given = Plan(params.data.scans, params.data.val_scans, 0, params.steps, params.validate_steps,
                 bool(network.part(params)))
    chosen = plan(asked.budget or BUDGET, cores(), speed, data, given, params.epochs)
    if params.validate_epochs and not params.validate_steps:
        epoch = max(1, round((chosen.scans + data.recorded) / data.batch))
        chosen = replace(chosen, validate_steps=params.validation_steps(epoch))
    _require_room(Path(params.data.cache), params.data.cache_gb, chosen, speed)
    _say(network, params, sensor, chosen, speed, data, _recorded_height(sources))
    write_text(path, json.dumps({"asked": settings,
                                 "plan": asdict(chosen),
                                 "speed": asdict(speed), "data": asdict(data)}, indent=1))


def _measured(network: Network, asked: Asked, params: Any, sensor: Sensor,
              device: torch.device) -> tuple[Speed, Sequence[Any], Sequence[Any]]:
    """What the machine does now, and the sources of scenes to train with and to validate on."""
    few = _few(params)
    sources, held_out = _scenes_of(asked, few, sensor)
    scenes, scan, scan_mb = _some_scenes((*sources, *held_out))
    cut, step, whole, frame = network.measured(few, scenes, held_out, device)
    return Speed(scan, cut, step, whole, frame, scan_mb), sources, held_out


def _few(params: Any) -> Any:
    return with_values(params, {"data.scans": 8, "data.val_scans": 1, "data.cache": ""})


def _refit(network: Network, asked: Asked, params: Any, sensor: Sensor, device: torch.device,
           begun: float, hours: float) -> None:
    """Plan fewer steps, before the first, where the preparation took longer than planned. How much
    slower steps are than planned is measured, as other work slows them in another way."""
    if (asked.out / STATE).exists():
        return
    made, speed, data = _planned(asked)

    def left() -> float:
        return begun + 3600 * hours - time.monotonic()
    passed = time.monotonic() - begun
    slower = max(1.0, (passed - STARTING) / preparing(made, cores(), speed))
    if refitted(made, left(), slower, speed, data) == made:
        return
    now = _measured(network, asked, params, sensor, device)[0]
    steps = now.step / speed.step if made.part else now.whole / speed.whole
    refit = refitted(made, left(), max(1.0, steps), speed, data)
    if refit != made:
        errors.print(f"the preparation took {duration(passed)}, {slower:.1f} times as long as "
                     f"planned, and a step takes {steps:.1f} times as long: {refit.steps} steps "
                     f"instead of {made.steps}")
        known = json.loads(read_text(asked.out / RUN, 10**6))
        write_text(asked.out / RUN, json.dumps({**known, "plan": asdict(refit)}, indent=1))


def _planned(asked: Asked) -> tuple[Plan, Speed, Data]:
    """What was planned, and from what."""
    known = json.loads(read_text(asked.out / RUN, 10**6))
    return Plan(**known["plan"]), Speed(**known["speed"]), Data(**known["data"])


def _settled(network: Network, asked: Asked, params: Any, settings: dict[str, Any]) -> Any:
    path = asked.out / RUN
    text = read_text(path, 10**6)
    try:
        known = json.loads(text)
        chosen = Plan(**known["plan"])
        different = differences(known["asked"], json.loads(json.dumps(settings)))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"cannot read {path}: {error!r}; give another --out") from None
    if different:
        raise InputError(f"{asked.out} holds a run with {'; '.join(different[:3])}; resume it with "
                         "the same settings, or give another --out")
    values = {"steps": chosen.steps, "validate_steps": chosen.validate_steps,
              "data.scans": chosen.scans, "data.val_scans": chosen.val_scans,
              **(network.part(params) if chosen.part else {})}
    return with_values(params, values)


def _settings_of(asked: Asked, params: Any, sensor: Sensor, init: Path | None) -> dict[str, Any]:
    """What a resumed run must have in common, of files what is in them: a split may name other
    frames now, and weights be others. InputError for scenes that are not there."""
    sources, held_out = _scenes_of(asked, _few(params), sensor)
    weights = sha256(init.read_bytes()).hexdigest()[:12] if init else ""
    return {**params.decisive(), "data": list(asked.data), "val": list(asked.val),
            "split": str(asked.split or ""), "val_split": str(asked.val_split or ""),
            "frame_names": _names(sources), "val_frame_names": _names(held_out),
            "init": str(asked.init or ""), "init_weights": weights, "sensor": asdict(sensor)}


def _names(sources: Sequence[Any]) -> list[str]:
    return [digest(source.names) for source in sources if isinstance(source, RecordedScenes)]


def _simulated(sources: Sequence[Any]) -> bool:
    return any(isinstance(source, SimulatedScenes) for source in sources)


def _recorded(sources: Sequence[Any]) -> int:
    return sum(len(source) for source in sources if not isinstance(source, SimulatedScenes))


def _recorded_height(sources: Sequence[Any]) -> float | None:
    """Metres of the sensor above the ground in the recordings, None where there are none, or they
    do not agree."""
    heights = [source.sensor_height for source in sources if isinstance(source, RecordedScenes)]
    if not heights or max(heights) - min(heights) >= HEIGHT_APART:
        return None
    return round(median(heights), 2)


def _about_sensor(params: Any, sensor: Sensor, sources: Sequence[Any]) -> dict[str, Any]:
    """What a header says of the sensor: which one was simulated; else how high it was."""
    if _simulated(sources):
        return {"name": params.sensor, "height": sensor.height, "beams": sensor.rings}
    height = _recorded_height(sources)
    return {} if height is None else {"height": height}


def _some_scenes(sources: Sequence[Any]) -> tuple[Iterable[Item], float, float]:
    """Items of some scenes, and the seconds to simulate one with its share of the scene, and its
    MB; 0 where nothing is simulated, and then scenes are read as they are asked for. No source has
    a cache."""
    for source in sources:
        if isinstance(source, SimulatedScenes):
            many = source.per_scene
            source.scene(0)  # so that what is compiled is there
            begun = time.perf_counter()
            made = [source.scene(i) for i in range(many, many + min(many, MOST))]
            return ([Item(scene) for scene in made], (time.perf_counter() - begun) / len(made),
                    made[0].points.nbytes * 1.02e-6)
    recorded = ReadScenes(tuple(sources), lambda source, i: source.scene(i))
    return (recorded[n] for n in range(len(recorded))), 0.0, 0.0


def _require_room(cache: Path, most_gb: float, chosen: Plan, speed: Speed) -> None:
    needed = min((chosen.scans + chosen.val_scans) * speed.scan_mb / 1e3, most_gb)
    free = shutil.disk_usage(cache).free / 1e9
    if needed + ROOM > free:
        raise InputError(f"{cache} needs {needed:.1f} GB for scans, and {free:.1f} GB are free: "
                         "give fewer --data-scans, a smaller --data-cache-gb or another --out")


def _say(network: Network, params: Any, sensor: Sensor, chosen: Plan, speed: Speed,
         data: Data, height: float | None) -> None:
    at = "" if height is None else f" at {height:g} m"
    scenes = " and ".join(text for count, text in (
        (chosen.scans, f"{chosen.scans} {params.scene} scans of {params.sensor} at "
                       f"{sensor.height:g} m"),
        (data.recorded, f"{data.recorded} recorded scenes{at}")) if count)
    part = network.part(params) if chosen.part else {}
    where = f" up to {part['ahead']:g} m ahead and {part['aside']:g} m aside" if part else ""
    often = (f"every {chosen.validate_steps} steps" if chosen.validate_steps < chosen.steps
             else "at the end")
    errors.print(f"{network.name}: {scenes}, {chosen.steps} steps of {data.batch} scenes{where}, "
                 f"validated {often} on "
                 f"{chosen.val_scans + data.val_recorded} other scenes")
    steps, validating = training(chosen, speed, data)
    only_cut = replace(chosen, scans=0, val_scans=0)
    cutting = preparing(only_cut, cores(), speed)
    parts = {"simulating": preparing(chosen, cores(), speed) - cutting, network.cutting: cutting,
             "steps": steps, "validation": validating}
    errors.print(f"about {duration(sum(parts.values()))} on {cores()} cores as busy as now, torch "
                 f"with {torch.get_num_threads()} threads: "
                 + ", ".join(f"{name} {duration(value)}" for name, value in parts.items()))
    errors.print(f"kept in {params.data.cache}; --resume goes on after a stop or a kill")


def _prepare(network: Network, asked: Asked, sources: Sequence[Any], held_out: Sequence[Any],
             cut: tuple[list[Any], list]) -> None:
    simulated = [s for s in (*sources, *held_out) if isinstance(s, SimulatedScenes)]
    keep_all(simulated, [range(len(s)) for s in simulated], asked.jobs, "simulating")
    keep_all(*cut, asked.jobs, network.cutting)


