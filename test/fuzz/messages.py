"""Part `messages`: mutated messages through the callbacks of every node."""

from __future__ import annotations

from fuzz.case import Case, Outcome, make_generator, pick
from fuzz.mutation import mutate_bytes
from fuzz.nodes import INPUTS, Nodes, draw_node
from fuzz.valid_messages import mutate_valid_message


def make_case(seed: int, number: int) -> Case:
    """Return a case with one message for one input of one node."""
    rng = make_generator("messages", seed, number)
    node = draw_node(rng)
    _, inputs, variants = INPUTS[node]
    topic = "input/points" if "input/points" in inputs and rng.random() < 0.7 else pick(rng, list(inputs))
    data, change = mutate_valid_message(inputs[topic], rng)
    if rng.random() < 0.1:
        data, damage = mutate_bytes(data, rng)
        change += f"; {damage}"
    then_valid = topic != "input/points" or bool(rng.random() < 0.125)
    return Case(f"{node}/{topic}: {change}", (node, topic, data, pick(rng, variants), then_valid))


class Attempt(Nodes):
    """Run cases."""

    def __call__(self, case: Case) -> Outcome:
        node, *values = case.settings
        return self.nodes[node].attempt(*values)
