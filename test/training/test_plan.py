"""Laws of the plan: what is planned fits into the time, and what is given stays."""

from __future__ import annotations

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lidar_perception.training import loop
from lidar_perception.training.loop import Pace
from lidar_perception.training.plan import (
    LEAST_STEPS,
    SCANS,
    Data,
    Plan,
    Speed,
    plan,
    preparing,
    refitted,
    training,
)
from lidar_perception.types import InputError

SPEED = Speed(scan=0.4, cut=0.1, step=1.2, whole=3.0, frame=0.2)
SIM = Data(True, True, 0, 0, 4, 500)
speeds = st.builds(
    lambda scan, cut, step, share, frame: Speed(scan, cut, step, step / share, frame),
    st.floats(0.05, 5), st.floats(0.01, 1), st.floats(0.01, 20), st.floats(0.2, 1),
    st.floats(0.01, 2))
data = st.one_of(st.builds(Data, st.just(True), st.just(True), st.integers(0, 5000), st.just(0),
                           st.integers(1, 32), st.integers(0, 10**9)),
                 st.builds(Data, st.just(False), st.just(False), st.integers(4, 5000),
                           st.integers(1, 50), st.integers(1, 32), st.integers(0, 500)))


@given(speeds, data, st.floats(0.3, 100), st.integers(1, 64))
def test_what_is_planned_fits_into_the_budget_or_is_refused_with_one_that_does(
        speed, data, hours, cores):
    try:
        made = plan(hours, cores, speed, data)
    except InputError as error:
        enough = float(re.search(r"--budget (\S+) or", str(error))[1])
        assert enough > 0.9 * hours
        if enough < 300:
            made = plan(1.1 * enough, cores, speed, data)
            assert made.steps >= LEAST_STEPS
        return
    assert preparing(made, cores, speed) + sum(training(made, speed, data)) <= 3600 * hours
    assert made.steps >= LEAST_STEPS and 1 <= made.validate_steps <= made.steps
    assert made.scans == 0 or SCANS[0] <= made.scans <= SCANS[1]
    assert (made.scans > 0) == data.simulated and (made.val_scans > 0) == data.val_simulated


def test_two_cores_in_two_hours():
    made = plan(2.0, 2, SPEED, SIM)
    assert 1000 < made.scans <= 3000 and made.part
    assert 3 * made.scans <= 4 * made.steps <= 10 * made.scans  # each is seen several times
    assert plan(50.0, 2, SPEED, SIM).part is False  # with much time all of the range is learned


def test_more_time_or_a_faster_machine_gives_more_of_everything():
    slow, fast = plan(1.0, 2, SPEED, SIM), plan(2.0, 2, SPEED, SIM)
    assert (slow.scans, slow.steps, slow.val_scans) < (fast.scans, fast.steps, fast.val_scans)
    assert slow.scans < plan(1.0, 4, SPEED, SIM).scans


def test_what_is_given_wins():
    made = plan(1.0, 2, SPEED, SIM, Plan(scans=30, val_scans=7, steps=5000, validate_steps=11,
                                         part=False))
    assert made == Plan(30, 7, 30, 5000, 11, False)  # it takes longer, as asked for
    assert plan(1.0, 2, SPEED, SIM, Plan(scans=100), epochs=3).steps == 75
    assert plan(1.0, 2, SPEED, SIM, Plan(steps=10)).scans <= 40  # no more than are looked at


@given(st.floats(0, 7200), st.floats(1, 20))
def test_after_a_slow_preparation_as_many_steps_are_left_as_fit(seconds, slower):
    made = plan(2.0, 2, SPEED, SIM)
    left = refitted(made, seconds, slower, SPEED, SIM)
    assert LEAST_STEPS <= left.steps <= made.steps and left.validate_steps <= left.steps
    assert (left.steps in (LEAST_STEPS, made.steps)
            or slower * sum(training(left, SPEED, SIM)) <= seconds)
    assert refitted(made, 7000.0, 1.0, SPEED, SIM) == made


def test_a_pace_says_how_many_steps_fit_beside_validations(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(loop.time, "monotonic", lambda: now[0])
    pace = Pace(until=1000.0, every=10)
    for _ in range(29):
        now[0] += 2.0
        pace.step()
        assert pace.fit(1) == math.inf and not pace.over()  # in its first minute
    with pace.validating():
        now[0] += 10.0
    now[0] += 2.0
    pace.step()
    # In 930 s: 2 steps, 30 times 10 s and 10 steps, 4 steps and 10 s for the last validation.
    assert pace.fit(8) == pytest.approx(2 + 30 * 10 + 4 - loop.SPARE, abs=1)
    for _ in range(400):
        now[0] += 4.0
        pace.step()
    assert pace.seconds == pytest.approx(4.0, abs=0.2)  # what was long ago hardly counts
    assert pace.over() and pace.fit(3) < 1
    endless = Pace(math.inf, 1)
    now[0] += 1e6
    endless.step()
    assert not endless.over() and endless.fit(1) == math.inf


@pytest.mark.parametrize("hours", [1e-4, 0.01])
def test_a_budget_that_is_too_short_names_one_that_is_not(hours):
    with pytest.raises(InputError, match="give --budget"):
        plan(hours, 2, SPEED, SIM)
