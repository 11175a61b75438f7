"""Access to private parts of rclpy 7 (Jazzy), for which it has no public interface."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter

InvalidHandle = rclpy_implementation.InvalidHandle
RCLError = rclpy_implementation.RCLError
UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError


class UnknownParameterError(ParameterNotDeclaredException):
    """A parameter is set but not declared; rclpy catches this and answers with its message.

    The message of rclpy itself is "Invalid access to undeclared parameter(s): []", because any()
    has consumed the generator of names (rclpy/node.py, _check_undeclared_parameters).
    """

    def __init__(self, message: str):
        Exception.__init__(self, message)


def parameter_overrides(node: Node) -> dict[str, Parameter]:
    """Return the mutable parameters that the user has set for this node, declared or not."""
    overrides: dict[str, Parameter] = node._parameter_overrides
    return overrides


def parameter_names(node: Node) -> list[str]:
    """Return the names of all declared parameters of a node."""
    return list(node._parameters)


def store_empty_list(node: Node, name: str, kind: Parameter.Type) -> None:
    """Give a declared parameter an empty list as its value.

    rclpy takes an empty list for one of bytes. A parameter that is declared by its type alone is
    "not set", and get_parameters then returns no values at all for any of the names it is given.
    """
    node._parameters[name] = Parameter(name, kind, [])


def clock_subscription(node: Node) -> Any:
    """Return the subscription to /clock that rclpy makes while use_sim_time is set, or None."""
    return node._time_source._clock_sub


def take_messages(subscription: Any, message_type: type) -> Iterator[tuple[bytes, dict]]:
    """Yield (bytes, message info) of all messages that wait in the middleware."""
    handle = subscription.handle
    with handle:
        while taken := handle.take_message(message_type, True):
            yield taken


def state_label(node: Any) -> str:
    """Return the lifecycle state of a managed node, such as "inactive" or "configuring"."""
    label: str = node._state_machine.current_state[1]
    return label


def allowed_transitions(node: Any) -> set[int | str]:
    """Return the ids and labels of the transitions that the current state allows."""
    return {key for number, label, *_ in node._state_machine.available_transitions for key in (number, label)}


def wrap_change_state(node: Any, wrapper: Callable[[Callable, Any, Any], Any]) -> None:
    """Let wrapper(original callback, request, response) answer the service ~/change_state."""
    original = node._service_change_state.callback
    node._service_change_state.callback = lambda *call: wrapper(original, *call)


def destroy_state_machine(node: Any) -> None:
    """Free the state machine, which keeps a destroyed node in the graph until it is collected."""
    node._state_machine.destroy_when_not_in_use()
