"""Training plans: how many scans, steps and validations fit into a time budget."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lidar_perception.types import InputError

RESERVE_SHARE = 0.1  # fraction of the budget reserved for everything that was not measured
STARTUP_S = 20.0  # time until all processes run
MAX_PREPARATION_SHARE = 0.25  # maximum fraction of the time to create scenes
VALIDATION_SHARE = 0.12  # fraction of the time to validate
SCANS_RANGE, VAL_SCANS_RANGE = (24, 3000), (16, 200)
MAX_VALIDATIONS = 6
PASSES_RANGE = 4, 80  # passes over the scenes: fewer undertrain, more teach nothing new
FULL_RANGE_STEPS = 12_000  # number of steps from which training covers the full detection range
MIN_STEPS = 20  # minimum number of steps for any effect


@dataclass(frozen=True)
class Speed:
    """Measured durations in seconds.

    Attributes:
        scan: To simulate a scan on one core; 0 if nothing is simulated.
        cut: To cut objects or clusters out of a scan on one core.
        step: A training step on the reduced range.
        whole: A training step on the whole range.
        frame: To validate a frame.
        scan_mb: Size of a cached scan, MB.
    """

    scan: float
    cut: float
    step: float
    whole: float
    frame: float
    scan_mb: float = 0.0


@dataclass(frozen=True)
class Plan:
    """Numbers of a training run.

    Attributes:
        scans, val_scans: Simulated scans to train on and to validate on.
        cuts: Scenes that objects or clusters are cut from.
        steps: Training steps.
        validate_steps: Steps from one validation to the next.
        part: Train on the reduced range only.
    """

    scans: int = 0
    val_scans: int = 0
    cuts: int = 0
    steps: int = 0
    validate_steps: int = 0
    part: bool = True


@dataclass(frozen=True)
class Data:
    """Scenes that are available.

    Attributes:
        simulated, val_simulated: Scans are simulated to train on, and to validate on.
        recorded, val_recorded: Recorded scenes to train on, and to validate on.
        batch: Scenes in a step.
        most_cuts: Largest number of scenes to cut objects or clusters from.
    """

    simulated: bool
    val_simulated: bool
    recorded: int
    val_recorded: int
    batch: int
    most_cuts: int


def fit_plan(hours: float, cores: int, speed: Speed, data: Data, given: Plan = Plan(), epochs: float = 0.0) -> Plan:
    """Return the plan that makes the best use of a time budget.

    It has as many scans as can be seen four times, in at most a quarter of the time. The steps get
    the time that scans and validations leave.

    Args:
        given: Numbers that are fixed where not 0, even if they exceed the budget; part=False
            rules out the reduced range.
        epochs: Fixed passes over the data, 0 for none.

    Raises:
        InputError: The budget is too short for MIN_STEPS.
    """
    fitting = _fit_any(hours, cores, speed, data, given, epochs)
    if given.steps or epochs or fitting.steps >= MIN_STEPS:
        return fitting
    enough = hours
    while _fit_any(enough, cores, speed, data, given, epochs).steps < MIN_STEPS:
        enough = 1.2 * enough
    raise InputError(
        f"a budget of {hours:g} h is too short for {MIN_STEPS} steps on this "
        f"machine: give --budget {1.05 * enough:.2g} or more, or fewer --data-scans "
        "and --data-val-scans"
    )


def _fit_any(hours: float, cores: int, speed: Speed, data: Data, given: Plan, epochs: float) -> Plan:
    """Fit a plan whose number of steps may be too small."""
    time = 3600 * hours * (1 - RESERVE_SHARE) - STARTUP_S
    scans, val, steps = given.scans, given.val_scans, given.steps
    if data.simulated and not scans:
        preparation = (speed.scan + speed.cut) / cores
        scans = _clip(
            min(
                MAX_PREPARATION_SHARE * time / preparation,
                (1 - VALIDATION_SHARE) * time / (preparation + PASSES_RANGE[0] * speed.step / data.batch),
            ),
            SCANS_RANGE,
        )
        scans = min(scans, steps * data.batch) if steps else scans
    scenes = (scans if data.simulated else 0) + data.recorded
    if data.val_simulated and not val:
        val = _clip(min(scenes / 8, VALIDATION_SHARE * time / MAX_VALIDATIONS / speed.frame), VAL_SCANS_RANGE)
    epoch = max(1, round(scenes / data.batch))
    steps = steps or (max(1, round(epochs * epoch)) if epochs else 0)
    unstepped = Plan(scans, val, given.cuts or min(scenes, data.most_cuts), steps, given.validate_steps)
    validation = speed.frame * (val + data.val_recorded)
    validations = max(1, min(MAX_VALIDATIONS, int(VALIDATION_SHARE * time / validation)))
    left = time - preparation_duration(unstepped, cores, speed) - validations * validation
    part = given.part and left / speed.whole < FULL_RANGE_STEPS
    steps = steps or max(0, min(int(left / (speed.step if part else speed.whole)), PASSES_RANGE[1] * epoch))
    return replace(
        unstepped, part=part, steps=steps, validate_steps=given.validate_steps or max(1, -(-steps // validations))
    )


def preparation_duration(plan: Plan, cores: int, speed: Speed) -> float:
    """Return the duration of making all scenes, in seconds."""
    return (speed.scan * (plan.scans + plan.val_scans) + speed.cut * plan.cuts) / cores


def training_durations(plan: Plan, speed: Speed, data: Data) -> tuple[float, float]:
    """Return the durations of all steps and of all validations, in seconds."""
    validations = -(-plan.steps // plan.validate_steps)
    return (
        plan.steps * (speed.step if plan.part else speed.whole),
        validations * validation_duration(plan, speed, data),
    )


def validation_duration(plan: Plan, speed: Speed, data: Data) -> float:
    """Return the duration of one validation, in seconds."""
    return (plan.val_scans + data.val_recorded) * speed.frame


def _clip(value: float, bounds: tuple[int, int]) -> int:
    return int(min(max(value, bounds[0]), bounds[1]))
