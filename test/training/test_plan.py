"""Training plans fit into the budget and keep given numbers."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.training import loop
from lidar_perception.training.loop import TimeBudget
from lidar_perception.training.plan import (
    MIN_STEPS,
    SCANS_RANGE,
    AvailableScenes,
    Plan,
    Speed,
    estimate_preparation_duration,
    estimate_training_durations,
    fit_plan,
)
from lidar_perception.types import InputError

SPEED = Speed(scan=0.4, cut=0.1, step=1.2, whole=3.0, frame=0.2)
SIM = AvailableScenes(True, True, 0, 0, 4, 500)
speeds = st.builds(
    lambda scan, cut, step, share, frame: Speed(cut, step, step / share, frame, scan),
    st.floats(0.05, 5),
    st.floats(0.01, 1),
    st.floats(0.01, 20),
    st.floats(0.2, 1),
    st.floats(0.01, 2),
)
data = st.one_of(
    st.builds(
        AvailableScenes,
        st.just(True),
        st.just(True),
        st.integers(0, 5000),
        st.just(0),
        st.integers(1, 32),
        st.integers(0, 10**9),
    ),
    st.builds(
        AvailableScenes,
        st.just(False),
        st.just(False),
        st.integers(4, 5000),
        st.integers(1, 50),
        st.integers(1, 32),
        st.integers(0, 500),
    ),
)


@given(speeds, data, st.floats(0.3, 100), st.integers(1, 64))
def test_plan_fits_the_budget_or_suggests_a_larger_one(speed, data, hours, cores):
    try:
        plan = fit_plan(hours, cores, speed, data)
    except InputError as error:
        enough = float(re.search(r"--budget (\S+) or", str(error))[1])
        assert enough > 0.9 * hours
        if enough < 300:
            plan = fit_plan(1.1 * enough, cores, speed, data)
            assert plan.steps >= MIN_STEPS
        return
    seconds = estimate_preparation_duration(plan, cores, speed) + sum(estimate_training_durations(plan, speed, data))
    assert seconds <= 3600 * hours
    assert plan.steps >= MIN_STEPS and 1 <= plan.validate_steps <= plan.steps
    assert plan.scans == 0 or SCANS_RANGE[0] <= plan.scans <= SCANS_RANGE[1]
    assert (plan.scans > 0) == data.simulated and (plan.val_scans > 0) == data.val_simulated


def test_plan_for_two_cores_and_two_hours():
    plan = fit_plan(2.0, 2, SPEED, SIM)
    assert 1000 < plan.scans <= 3000 and plan.part
    assert 3 * plan.scans <= 4 * plan.steps <= 10 * plan.scans  # each scene is seen several times
    assert fit_plan(50.0, 2, SPEED, SIM).part is False  # with enough time, the full range


def test_more_time_or_cores_give_larger_plan():
    slow, fast = fit_plan(1.0, 2, SPEED, SIM), fit_plan(2.0, 2, SPEED, SIM)
    assert (slow.scans, slow.steps, slow.val_scans) < (fast.scans, fast.steps, fast.val_scans)
    assert slow.scans < fit_plan(1.0, 4, SPEED, SIM).scans


def test_plan_keeps_values_given_by_the_user():
    plan = fit_plan(1.0, 2, SPEED, SIM, Plan(scans=30, val_scans=7, steps=5000, validate_steps=11, part=False))
    assert plan == Plan(30, 7, 30, 5000, 11, False)  # although it takes longer than the budget
    assert fit_plan(1.0, 2, SPEED, SIM, Plan(scans=100), epochs=3).steps == 75
    assert fit_plan(1.0, 2, SPEED, SIM, Plan(steps=10)).scans <= 40  # not more scans than the steps use


def test_remaining_steps_include_the_time_of_validations(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(loop.time, "monotonic", lambda: now[0])
    budget = TimeBudget(deadline=1000.0, validate_steps=10)
    for _ in range(29):
        now[0] += 2.0
        budget.count_step()
        assert budget.estimate_remaining_steps(1) == math.inf and not budget.is_over()  # in its first minute
    with budget.time_validation():
        now[0] += 10.0
    now[0] += 2.0
    budget.count_step()
    # In 930 s: 2 steps, 30 times 10 s and 10 steps, 4 steps and 10 s for the last validation.
    assert budget.estimate_remaining_steps(8) == pytest.approx(2 + 30 * 10 + 4 - loop.SPARE_STEPS, abs=1)
    for _ in range(400):
        now[0] += 4.0
        budget.count_step()
    assert budget.step_duration == pytest.approx(4.0, abs=0.2)  # old steps have little weight
    assert budget.is_over() and budget.estimate_remaining_steps(3) < 1
    endless = TimeBudget(math.inf, 1)
    now[0] += 1e6
    endless.count_step()
    assert not endless.is_over() and endless.estimate_remaining_steps(1) == math.inf


@pytest.mark.parametrize("hours", [1e-4, 0.01])
def test_too_short_budget_is_rejected_with_a_suggestion(hours):
    with pytest.raises(InputError, match="give --budget"):
        fit_plan(hours, 2, SPEED, SIM)
