"""Base class of all nodes: parameters from dataclasses, inputs, outputs and diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future

from lidar_perception.nodes.diagnostics import Diagnostics
from lidar_perception.nodes.links import Links, Outputs
from lidar_perception.nodes.parameter_declaration import convert_to_declared_type, declare_parameters
from lidar_perception.nodes.rclpy_compat import UnknownParameterError, list_parameter_names
from lidar_perception.nodes.subscriptions import Inputs
from lidar_perception.param_fields import flatten, with_values
from lidar_perception.types import find_closest_name


class LidarNode(Node):
    """A node that reports bad input as a diagnostic instead of ending.

    Args:
        name: name of the node.
        params: dataclass with the parameters of the algorithm. Its fields are declared as ROS
            parameters, and changes at run time are checked in the same way.
        node_params: dataclass with the other parameters of the node, such as BoxNodeParams.
        links: links to the other nodes of the process; None if there are none.
        options: further arguments of rclpy.node.Node.

    Attributes:
        diagnostics: state, counts and times.
        inputs: subscriptions.
        outputs: publishers of results.
        transforms: a Transforms object in nodes that subscribe to clouds.
        stop: future that ends the node; any thread may set it.
    """

    transforms: Any = None
    writes_files: ClassVar[bool] = False  # True if close() writes files, which a signal must not interrupt

    def __init__(self, name: str, params: Any, node_params: Any = None, links: Links | None = None, **options: Any):
        super().__init__(name, **options)
        self.links = links
        self.params = declare_parameters(self, params)
        self.node_params = node_params and declare_parameters(self, node_params)
        self.add_pre_set_parameters_callback(self._before_set)
        self.add_on_set_parameters_callback(self._on_set)
        self.stop = Future()
        self.diagnostics = Diagnostics(self)
        self.inputs, self.outputs = Inputs(self), Outputs(self, links)
        self.diagnostics.sources += [self.inputs, self.outputs]
        self.add_steady_timer(1.0, self.publish_status)

    def start(self) -> None:
        """Start the node; called once before it spins."""

    def is_ready(self) -> bool:
        """Return True once the node processes its input."""
        return True

    def spin(self, executor: Executor) -> None:
        """Spin until self.stop is done."""
        executor.spin_until_future_complete(self.stop)

    def close(self) -> None:
        """Write the remaining results; called once before the node is destroyed.

        Raises:
            InputError: the results cannot be written.
        """

    def add_steady_timer(self, seconds: float, callback: Callable[[], None]) -> None:
        """Call callback() periodically in real time, even if the simulated clock is paused."""
        self.create_timer(seconds, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish_status(self) -> None:
        """Adapt to changed publishers, retry waiting clouds and publish the diagnostics."""
        self.inputs.adapt()
        self.inputs.retry()
        self.diagnostics.publish()

    def _before_set(self, changes: list[Parameter]) -> list[Parameter]:
        if unknown_names := [c.name for c in changes if not self.has_parameter(c.name)]:
            guess = find_closest_name(unknown_names[0], list_parameter_names(self))
            raise UnknownParameterError(
                f"{self.get_fully_qualified_name()} has no parameter "
                f"{unknown_names[0][:80]!r}" + (f"; did you mean {guess!r}?" if guess else "")
            )
        return [convert_to_declared_type(c, self.get_parameter(c.name).type_) for c in changes]

    def _on_set(self, changes: list[Parameter]) -> SetParametersResult:
        try:
            params, node_params = (
                group and with_values(group, {c.name: c.value for c in changes if c.name in flatten(group)})
                for group in (self.params, self.node_params)
            )
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.params, self.node_params = params, node_params
        return SetParametersResult(successful=True)
