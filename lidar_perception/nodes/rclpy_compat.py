"""Access to private parts of rclpy 7 (Jazzy) that have no public interface."""

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
    """Raised for a parameter that is not declared; rclpy catches it and responds with its message.

    The message of rclpy itself is "Invalid access to undeclared parameter(s): []", because any()
    has consumed the generator of names (rclpy/node.py, _check_undeclared_parameters).
    """

    def __init__(self, message: str):
        Exception.__init__(self, message)


def get_parameter_overrides(node: Node) -> dict[str, Parameter]:
    """Return the parameters that the user has set for this node, declared or not; the dict is mutable."""
    overrides: dict[str, Parameter] = node._parameter_overrides
    return overrides


def list_parameter_names(node: Node) -> list[str]:
    """Return the names of all declared parameters of a node."""
    return list(node._parameters)


def store_empty_list(node: Node, name: str, kind: Parameter.Type) -> None:
    """Set a declared parameter to an empty list.

    rclpy interprets an empty list as a list of bytes. A parameter that is declared only by its type
    is "not set", and get_parameters then returns no values at all for a request that names it.
    """
    node._parameters[name] = Parameter(name, kind, [])


def get_clock_subscription(node: Node) -> Any:
    """Return the subscription to /clock that rclpy creates if use_sim_time is set, or None."""
    return node._time_source._clock_sub


def take_messages(subscription: Any, message_type: type) -> Iterator[tuple[bytes, dict]]:
    """Yield (bytes, message info) of all messages in the queue of the middleware."""
    handle = subscription.handle
    with handle:
        while message := handle.take_message(message_type, True):
            yield message


def get_state_label(node: Any) -> str:
    """Return the lifecycle state of a managed node, such as "inactive" or "configuring"."""
    label: str = node._state_machine.current_state[1]
    return label


def list_allowed_transitions(node: Any) -> set[int | str]:
    """Return the ids and labels of the transitions that the current state allows."""
    return {key for number, label, *_ in node._state_machine.available_transitions for key in (number, label)}


def wrap_change_state(node: Any, wrapper: Callable[[Callable, Any, Any], Any]) -> None:
    """Replace the callback of ~/change_state by wrapper(original callback, request, response)."""
    original = node._service_change_state.callback
    node._service_change_state.callback = lambda *arguments: wrapper(original, *arguments)


def destroy_state_machine(node: Any) -> None:
    """Destroy the state machine, which would keep a destroyed node in the ROS graph until collected."""
    node._state_machine.destroy_when_not_in_use()
