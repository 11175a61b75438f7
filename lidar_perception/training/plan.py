"""How much fits into a time: scans, steps and validations, from the speed of a machine."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lidar_perception.types import InputError

RESERVE = 0.1         # of the budget, for what was not measured
STARTING = 20.0       # seconds until processes run
PREPARING = 0.25      # of the time, at most, to make scenes
VALIDATING = 0.12     # of it, to validate
SCANS, VAL_SCANS = (24, 3000), (16, 200)
VALIDATIONS = 6
PASSES = 4, 80        # over the scenes: fewer show too little of each, more learn nothing new
WHOLE_RANGE = 12_000  # steps from which on the whole range is trained on, not a part of it
LEAST_STEPS = 20      # in fewer nothing is learned


@dataclass(frozen=True)
class Speed:
    """What was measured, in seconds: scan, cut: of one core, to simulate a scan and to cut objects
    or clusters out of it (scan 0: nothing is simulated); step, whole: a step on the part of the
    range that is quicker, and on all of it; frame: to validate a frame. scan_mb: size of what is
    kept of a scan."""

    scan: float
    cut: float
    step: float
    whole: float
    frame: float
    scan_mb: float = 0.0


@dataclass(frozen=True)
class Plan:
    """scans to train on, val_scans to validate on, cuts: scenes that are cut; steps, and
    validate_steps from one validation to the next; part: only the quick part of the range."""

    scans: int = 0
    val_scans: int = 0
    cuts: int = 0
    steps: int = 0
    validate_steps: int = 0
    part: bool = True


@dataclass(frozen=True)
class Data:
    """What is there to learn from: whether scans are simulated to train on, and to validate on; how
    many recorded scenes there are of both; scenes in a step; scenes that are cut at most."""

    simulated: bool
    val_simulated: bool
    recorded: int
    val_recorded: int
    batch: int
    most_cuts: int


def plan(hours: float, cores: int, speed: Speed, data: Data, given: Plan = Plan(),
         epochs: float = 0.0) -> Plan:
    """The plan that fits into so many hours. given: what is fixed, where it is not 0 (part False:
    no part of the range), whether it fits or not; epochs: passes over the data, likewise.

    As many scenes as are seen four times, and take a quarter of the time at most; what these and
    validation leave is for steps. InputError if the time is too short for LEAST_STEPS.
    """
    made = _fitted(hours, cores, speed, data, given, epochs)
    if given.steps or epochs or made.steps >= LEAST_STEPS:
        return made
    enough = hours
    while _fitted(enough, cores, speed, data, given, epochs).steps < LEAST_STEPS:
        enough = 1.2 * enough
    raise InputError(f"a budget of {hours:g} h is too short for {LEAST_STEPS} steps on this "
                     f"machine: give --budget {1.05 * enough:.2g} or more, or fewer --data-scans "
                     "and --data-val-scans")


def _fitted(hours: float, cores: int, speed: Speed, data: Data, given: Plan,
            epochs: float) -> Plan:
    """As plan, with as few steps as there is time for."""
    time = 3600 * hours * (1 - RESERVE) - STARTING
    scans, val, steps = given.scans, given.val_scans, given.steps
    if data.simulated and not scans:
        each = (speed.scan + speed.cut) / cores
        scans = _within(min(PREPARING * time / each, (1 - VALIDATING) * time / (
            each + PASSES[0] * speed.step / data.batch)), SCANS)
        scans = min(scans, steps * data.batch) if steps else scans
    scenes = (scans if data.simulated else 0) + data.recorded
    if data.val_simulated and not val:
        val = _within(min(scenes / 8, VALIDATING * time / VALIDATIONS / speed.frame), VAL_SCANS)
    epoch = max(1, round(scenes / data.batch))
    steps = steps or (max(1, round(epochs * epoch)) if epochs else 0)
    made = Plan(scans, val, given.cuts or min(scenes, data.most_cuts), steps, given.validate_steps)
    once = speed.frame * (val + data.val_recorded)
    validations = max(1, min(VALIDATIONS, int(VALIDATING * time / once)))
    left = time - preparing(made, cores, speed) - validations * once
    part = given.part and left / speed.whole < WHOLE_RANGE
    steps = steps or max(0, min(int(left / (speed.step if part else speed.whole)),
                                PASSES[1] * epoch))
    return replace(made, part=part, steps=steps,
                   validate_steps=given.validate_steps or max(1, -(-steps // validations)))


def refitted(made: Plan, seconds: float, slower: float, speed: Speed, data: Data) -> Plan:
    """The plan with as many of its steps as fit into what time is left, on a machine that many
    times slower than measured; LEAST_STEPS at least."""
    steps, validating = training(made, speed, data)
    fit = ((1 - RESERVE) * seconds / slower - validating) / (steps / made.steps)
    few = min(made.steps, max(LEAST_STEPS, int(fit)))
    validations = -(-made.steps // made.validate_steps)
    return made if few > (1 - RESERVE) * made.steps else replace(
        made, steps=few, validate_steps=-(-few // validations))


def preparing(plan: Plan, cores: int, speed: Speed) -> float:
    """Seconds to make all scenes."""
    return (speed.scan * (plan.scans + plan.val_scans) + speed.cut * plan.cuts) / cores


def training(plan: Plan, speed: Speed, data: Data) -> tuple[float, float]:
    """Seconds of all steps, and of all validations."""
    validations = -(-plan.steps // plan.validate_steps)
    return (plan.steps * (speed.step if plan.part else speed.whole),
            validations * validation(plan, speed, data))


def validation(plan: Plan, speed: Speed, data: Data) -> float:
    """Seconds of one validation."""
    return (plan.val_scans + data.val_recorded) * speed.frame


def _within(value: float, bounds: tuple[int, int]) -> int:
    return int(min(max(value, bounds[0]), bounds[1]))
