"""Part `parameters`: hostile parameter values at run time. The node rejects a value with a reason, or accepts it
and still processes valid messages."""

from __future__ import annotations

from typing import Any

import numpy as np
from rclpy.parameter import Parameter

from fuzz.case import FAILED, REFUSED, Case, Outcome, make_generator, pick
from fuzz.mutation import FLOATS, INTEGERS, TEXTS
from fuzz.nodes import BUG, FedNode, Nodes, draw_node
from lidar_perception.nodes.rclpy_compat import list_parameter_names

NOT_OURS = ("qos_overrides.", "use_sim_time", "start_type_description_service")


def make_case(seed: int, number: int) -> Case:
    """Return a case for one node; parameters and values are drawn once the node exists."""
    node = draw_node(make_generator("parameters", seed, number))
    return Case(f"{node}, {number}", (node, seed, number))


class Attempt(Nodes):
    """Run cases."""

    def __call__(self, case: Case) -> Outcome:
        name, seed, number = case.settings
        fed, rng = self.nodes[name], make_generator("values", seed, number)
        names = [name for name in list_parameter_names(fed.node) if not name.startswith(NOT_OURS)]
        before = [fed.node.get_parameter(pick(rng, names)) for _ in range(pick(rng, (1, 1, 1, 2)))]
        changes = [Parameter(p.name, value=make_hostile_value(p.value, rng, find_limits(fed, p.name))) for p in before]
        description = ", ".join(f"{p.name} = {str(p.value)[:40]!r}" for p in changes)
        result = fed.node.set_parameters_atomically(changes)
        if not result.successful:
            return Outcome(REFUSED if result.reason else FAILED, f"{description}: {result.reason}")
        states = fed.deliver_valid()
        outcome = fed.judge([s for s in states if BUG in s[1]] or states[:1])
        if not fed.node.set_parameters_atomically(before).successful:
            return Outcome(FAILED, f"{description}: the value before is refused")
        if outcome.verdict != FAILED:
            outcome = fed.judge(fed.deliver_valid())
        return Outcome(outcome.verdict, f"{description}: {outcome.reason}")


def find_limits(fed: FedNode, name: str) -> list[float]:
    """Return the lowest and highest value of a parameter; empty if it has no range."""
    described = fed.node.describe_parameter(name)
    return [
        value
        for found in (*described.floating_point_range, *described.integer_range)
        for value in (found.from_value, found.to_value)
    ]


def make_hostile_value(value: Any, rng: np.random.Generator, limits: list[float]) -> Any:
    """Return another value, mostly of the same type, often one of the limits."""
    kind = type(value) if rng.random() < 0.9 else pick(rng, (bool, int, float, str))
    if kind in (int, float) and limits and rng.random() < 0.5:
        return kind(pick(rng, limits))
    if kind is bool:
        return not value
    if kind is int:
        return int(np.clip(pick(rng, INTEGERS), 0, 2**63 - 1)) * pick(rng, (1, -1))
    if kind is float:
        return float(pick(rng, (*FLOATS, 1e-3, 0.5, 10.0)))
    if kind is str:
        return pick(rng, TEXTS)
    items = [make_hostile_value(item, rng, limits) for item in value]
    return (
        []
        if not items or rng.random() < 0.3
        else [item if isinstance(item, type(value[0])) else value[0] for item in items]
    )
