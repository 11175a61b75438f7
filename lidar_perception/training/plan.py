"""Training plans: how many scans, steps and validations fit into a time budget."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lidar_perception.types import InputError

RESERVE_SHARE = 0.1  # fraction of the budget reserved for everything that is not measured
STARTUP_S = 20.0  # time until all processes run
MAX_PREPARATION_SHARE = 0.25  # maximum fraction of the time for the preparation of scenes
VALIDATION_SHARE = 0.12  # fraction of the time for validations
SCANS_RANGE, VAL_SCANS_RANGE = (24, 3000), (16, 200)
MAX_VALIDATIONS = 6
EPOCHS_RANGE = 4, 80
FULL_RANGE_STEPS = 12_000  # runs with at least this many steps cover the whole detection range
MIN_STEPS = 20


@dataclass(frozen=True)
class Speed:
    """Measured durations in seconds.

    Attributes:
        scan: Simulation of a scan on one core; 0 if nothing is simulated.
        cut: Cutting of objects or clusters from a scan on one core.
        step: Training step on the reduced range.
        whole: Training step on the whole range.
        frame: Validation of a frame.
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
    """Plan of a training run.

    Attributes:
        scans, val_scans: Numbers of simulated training and validation scans.
        cuts: Number of scenes from which objects or clusters are cut.
        steps: Number of training steps.
        validate_steps: Steps between validations.
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
    """Available scenes.

    Attributes:
        simulated, val_simulated: Training or validation scans are simulated.
        recorded, val_recorded: Numbers of recorded training and validation scenes.
        batch: Scenes per step.
        most_cuts: Largest number of scenes from which objects or clusters are cut.
    """

    simulated: bool
    val_simulated: bool
    recorded: int
    val_recorded: int
    batch: int
    most_cuts: int


def fit_plan(hours: float, cores: int, speed: Speed, data: Data, fixed: Plan = Plan(), epochs: float = 0.0) -> Plan:
    """Fit a plan to a time budget.

    It has as many scans as can be used in EPOCHS_RANGE[0] epochs and prepared in
    MAX_PREPARATION_SHARE of the time. The rest of the time, without validations, is for the steps.

    Args:
        hours: Budget.
        cores: CPU cores that prepare scenes.
        speed: Measured durations.
        data: Available scenes.
        fixed: Numbers other than 0 are kept, even if they exceed the budget; part=False excludes
            the reduced range.
        epochs: Number of epochs, 0 to fit it.

    Raises:
        InputError: The budget is too short for MIN_STEPS.
    """
    plan = _fit_unchecked(hours, cores, speed, data, fixed, epochs)
    if fixed.steps or epochs or plan.steps >= MIN_STEPS:
        return plan
    min_hours = hours
    while _fit_unchecked(min_hours, cores, speed, data, fixed, epochs).steps < MIN_STEPS:
        min_hours = 1.2 * min_hours
    raise InputError(
        f"a budget of {hours:g} h is too short for {MIN_STEPS} steps on this machine: "
        f"give --budget {1.05 * min_hours:.2g} or more, or fewer --data-scans and --data-val-scans"
    )


def _fit_unchecked(hours: float, cores: int, speed: Speed, data: Data, fixed: Plan, epochs: float) -> Plan:
    """Fit a plan whose number of steps may be too small."""
    time = 3600 * hours * (1 - RESERVE_SHARE) - STARTUP_S
    scans, val_scans, steps = fixed.scans, fixed.val_scans, fixed.steps
    if data.simulated and not scans:
        preparation = (speed.scan + speed.cut) / cores
        preparable = MAX_PREPARATION_SHARE * time / preparation
        trainable = (1 - VALIDATION_SHARE) * time / (preparation + EPOCHS_RANGE[0] * speed.step / data.batch)
        scans = _clip(min(preparable, trainable), SCANS_RANGE)
        scans = min(scans, steps * data.batch) if steps else scans
    scenes = (scans if data.simulated else 0) + data.recorded
    if data.val_simulated and not val_scans:
        val_scans = _clip(min(scenes / 8, VALIDATION_SHARE * time / MAX_VALIDATIONS / speed.frame), VAL_SCANS_RANGE)
    epoch = max(1, round(scenes / data.batch))
    steps = steps or (max(1, round(epochs * epoch)) if epochs else 0)
    plan = Plan(scans, val_scans, fixed.cuts or min(scenes, data.most_cuts), steps, fixed.validate_steps)
    validation = speed.frame * (val_scans + data.val_recorded)
    validations = max(1, min(MAX_VALIDATIONS, int(VALIDATION_SHARE * time / validation)))
    time_left = time - preparation_duration(plan, cores, speed) - validations * validation
    part = fixed.part and time_left / speed.whole < FULL_RANGE_STEPS
    steps = steps or max(0, min(int(time_left / (speed.step if part else speed.whole)), EPOCHS_RANGE[1] * epoch))
    validate_steps = fixed.validate_steps or max(1, -(-steps // validations))
    return replace(plan, part=part, steps=steps, validate_steps=validate_steps)


def preparation_duration(plan: Plan, cores: int, speed: Speed) -> float:
    """Return the duration of simulating and cutting all scenes, in seconds."""
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
