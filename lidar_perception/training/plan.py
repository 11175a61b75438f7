"""Training plans: how many scans, steps and validations fit into a time budget."""

from __future__ import annotations

from dataclasses import dataclass, replace

from lidar_perception.types import InputError

RESERVE_FRACTION = 0.1  # fraction of the budget kept in reserve for work that is not measured
STARTUP_S = 20.0  # time until all processes run
MAX_PREPARATION_FRACTION = 0.25  # maximum fraction of the time for the preparation of scenes
VALIDATION_FRACTION = 0.12  # fraction of the time for validations
SCANS_RANGE, VAL_SCANS_RANGE = (24, 3000), (16, 200)
MAX_VALIDATIONS = 6
EPOCHS_RANGE = 4, 80
FULL_RANGE_STEPS = 12_000  # runs with at least this many steps cover the full detection range
MIN_STEPS = 20


@dataclass(frozen=True)
class Speed:
    """Measured durations in seconds, and the size of a scan.

    Attributes:
        cut: Duration of cutting the objects or clusters from a scan on one core.
        step: Duration of a training step on the reduced range.
        whole: Duration of a training step on the full range.
        frame: Duration of validating a frame.
        scan: Duration of simulating a scan on one core; 0 if nothing is simulated.
        scan_mb: Size of a cached scan, MB.
    """

    cut: float
    step: float
    whole: float
    frame: float
    scan: float = 0.0
    scan_mb: float = 0.0


@dataclass(frozen=True)
class Plan:
    """Plan of a training run.

    Attributes:
        scans, val_scans: Number of simulated training and validation scans.
        cuts: Number of scenes from which objects or clusters are cut.
        steps: Number of training steps.
        validate_steps: Steps between validations.
        part: True to train on the reduced range only.
    """

    scans: int = 0
    val_scans: int = 0
    cuts: int = 0
    steps: int = 0
    validate_steps: int = 0
    part: bool = True


@dataclass(frozen=True)
class AvailableScenes:
    """Numbers of scenes that a plan can use.

    Attributes:
        simulated: True if (some) training scans are simulated.
        val_simulated: True if (some) validation scans are simulated.
        recorded, val_recorded: Number of recorded training and validation scenes.
        batch: Scenes per step.
        most_cuts: Maximum number of scenes from which objects or clusters are cut.
    """

    simulated: bool
    val_simulated: bool
    recorded: int
    val_recorded: int
    batch: int
    most_cuts: int


def fit_plan(
    hours: float, cores: int, speed: Speed, data: AvailableScenes, user_plan: Plan = Plan(), epochs: float = 0.0
) -> Plan:
    """Fit a plan to a time budget.

    It has as many scans as can be used in EPOCHS_RANGE[0] epochs and prepared in
    MAX_PREPARATION_FRACTION of the time. The steps get the rest of the time, apart from validations.

    Args:
        hours: Time budget.
        cores: CPU cores that prepare scenes.
        speed: Measured durations.
        data: Available scenes.
        user_plan: Numbers other than 0 are kept, even if they exceed the budget; part=False
            excludes the reduced range.
        epochs: Number of epochs; 0 to choose it by the budget.

    Raises:
        InputError: The budget is too short for MIN_STEPS.
    """
    plan = _fit_unchecked(hours, cores, speed, data, user_plan, epochs)
    if user_plan.steps or epochs or plan.steps >= MIN_STEPS:
        return plan
    min_hours = hours
    while _fit_unchecked(min_hours, cores, speed, data, user_plan, epochs).steps < MIN_STEPS:
        min_hours = 1.2 * min_hours
    raise InputError(
        f"a budget of {hours:g} h is too short for {MIN_STEPS} steps on this machine: "
        f"give --budget {1.05 * min_hours:.2g} or more, or fewer --data-scans and --data-val-scans"
    )


def _fit_unchecked(
    hours: float, cores: int, speed: Speed, data: AvailableScenes, user_plan: Plan, epochs: float
) -> Plan:
    """Fit a plan whose number of steps may be too small."""
    time = 3600 * hours * (1 - RESERVE_FRACTION) - STARTUP_S
    scans, val_scans, steps = user_plan.scans, user_plan.val_scans, user_plan.steps
    if data.simulated and not scans:
        preparation = (speed.scan + speed.cut) / cores
        max_prepared = MAX_PREPARATION_FRACTION * time / preparation
        max_trained = (1 - VALIDATION_FRACTION) * time / (preparation + EPOCHS_RANGE[0] * speed.step / data.batch)
        scans = _clip(min(max_prepared, max_trained), SCANS_RANGE)
        scans = min(scans, steps * data.batch) if steps else scans
    scenes = (scans if data.simulated else 0) + data.recorded
    if data.val_simulated and not val_scans:
        val_scans = _clip(min(scenes / 8, VALIDATION_FRACTION * time / MAX_VALIDATIONS / speed.frame), VAL_SCANS_RANGE)
    epoch = max(1, round(scenes / data.batch))
    steps = steps or (max(1, round(epochs * epoch)) if epochs else 0)
    plan = Plan(scans, val_scans, user_plan.cuts or min(scenes, data.most_cuts), steps, user_plan.validate_steps)
    validation = speed.frame * (val_scans + data.val_recorded)
    validations = max(1, min(MAX_VALIDATIONS, int(VALIDATION_FRACTION * time / validation)))
    time_left = time - estimate_preparation_duration(plan, cores, speed) - validations * validation
    part = user_plan.part and time_left / speed.whole < FULL_RANGE_STEPS
    steps = steps or max(0, min(int(time_left / (speed.step if part else speed.whole)), EPOCHS_RANGE[1] * epoch))
    validate_steps = user_plan.validate_steps or max(1, -(-steps // validations))
    return replace(plan, part=part, steps=steps, validate_steps=validate_steps)


def estimate_preparation_duration(plan: Plan, cores: int, speed: Speed) -> float:
    """Estimate the duration of simulating and cutting all scenes, in seconds."""
    return (speed.scan * (plan.scans + plan.val_scans) + speed.cut * plan.cuts) / cores


def estimate_training_durations(plan: Plan, speed: Speed, data: AvailableScenes) -> tuple[float, float]:
    """Estimate the total durations of the steps and of the validations, in seconds."""
    validations = -(-plan.steps // plan.validate_steps)
    return (
        plan.steps * (speed.step if plan.part else speed.whole),
        validations * estimate_validation_duration(plan, speed, data),
    )


def estimate_validation_duration(plan: Plan, speed: Speed, data: AvailableScenes) -> float:
    """Estimate the duration of one validation, in seconds."""
    return (plan.val_scans + data.val_recorded) * speed.frame


def _clip(value: float, bounds: tuple[int, int]) -> int:
    return int(min(max(value, bounds[0]), bounds[1]))
