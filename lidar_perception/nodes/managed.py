"""Base class of lifecycle nodes, which a lifecycle manager (such as Nav2's) can control."""

from __future__ import annotations

import ctypes
import gc
import sys
import traceback
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from lidar_perception.nodes.autostart import UNCONFIGURED, Autostart
from lidar_perception.nodes.diagnostics import ERROR, OK, WAITING, WARN, Problem
from lidar_perception.nodes.rclpy_compat import (
    destroy_state_machine,
    get_clock_subscription,
    get_state_label,
    list_allowed_transitions,
    wrap_change_state,
)
from lidar_perception.nodes.runtime import LidarNode
from lidar_perception.nodes.transforms import Transforms
from lidar_perception.runs.compiling import report_compilation
from lidar_perception.runs.files import convert_os_errors
from lidar_perception.types import InputError

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
INACTIVE = "not active"
# Attribute of a node with a list of ROS entities -> method that destroys one of them.
ENTITIES: dict[str, Any] = {
    "publishers": Node.destroy_publisher,
    "subscriptions": Node.destroy_subscription,
    "clients": Node.destroy_client,
    "services": Node.destroy_service,
    "timers": Node.destroy_timer,
    "guards": Node.destroy_guard_condition,
}


class ManagedNode(LifecycleNodeMixin, LidarNode):
    """A LidarNode with a lifecycle, see https://design.ros2.org/articles/node_lifecycle.html.

    A subclass only implements configure(). Its inputs are open while the node is active. A cleanup
    undoes configure(), which frees the memory of a network.

    Args:
        name: name of the node.
        params: see LidarNode.
        node_params: see LidarNode; must have the field autostart.
        watched_inputs: see Autostart.
        options: further arguments of LidarNode.
    """

    def __init__(
        self, name: str, params: Any, node_params: Any, watched_inputs: tuple[str, ...] = ("points",), **options: Any
    ):
        LidarNode.__init__(self, name, params, node_params, **options)
        LifecycleNodeMixin.__init__(self)
        self.inputs.is_open = False
        self.diagnostics.state = (OK, UNCONFIGURED)
        self.diagnostics.sources.append(self)
        self.autostart = Autostart(self, watched_inputs)
        self._snapshot: NodeSnapshot | None = None  # state before configure()
        wrap_change_state(self, self._change)

    def configure(self) -> None:
        """Create outputs and inputs, and load networks.

        Raises:
            InputError: a file is missing or unusable.
        """
        raise NotImplementedError

    def start(self) -> None:
        self.autostart.start()

    def is_ready(self) -> bool:
        return self.get_state_label() == "active"

    def destroy_node(self) -> None:
        super().destroy_node()
        destroy_state_machine(self)

    def get_state_label(self) -> str:
        """Return the lifecycle state, such as "inactive", or "configuring" in a transition."""
        return get_state_label(self)

    def values(self) -> dict[str, Any]:
        """Return the lifecycle state for the diagnostics."""
        return {"lifecycle": self.get_state_label()}

    def problems(self) -> list[Problem]:
        """Return an empty list, because no lifecycle state is a problem."""
        return []

    def _change(self, change: Callable, request: Any, response: Any) -> Any:
        """Change the state, or reject the request if the state does not allow it; rclpy would crash."""
        transition = request.transition.label or request.transition.id
        if transition in list_allowed_transitions(self):
            self.autostart.retry_at = None
            return change(request, response)
        self.get_logger().error(
            f"transition {transition} is not possible: the node is {self.get_state_label()}"
            + (
                "; set the parameter autostart to false for use with a lifecycle manager"
                if self.node_params.autostart
                else ""
            )
        )
        response.success = False
        return response

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.autostart.unmanaged_since = None
        self._snapshot = NodeSnapshot(self)
        if self.autostart.retry_at is None:
            self.diagnostics.report(WARN, "configuring", expected=True)
        state_before = self.diagnostics.state
        if problem := self._run_step(self._configure):
            self._undo_configuration()
            self.diagnostics.report(ERROR, f"{UNCONFIGURED}, so this node publishes nothing: {problem}")
            return FAILURE
        if self.diagnostics.state == state_before:
            self.diagnostics.state = (OK, INACTIVE)
        return SUCCESS

    def _configure(self) -> None:
        self.transforms = Transforms(self)
        self.diagnostics.sources.append(self.transforms)
        with report_compilation(self.get_logger().info):
            self.configure()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        if problem := self._run_step(self.inputs.open):
            self.inputs.close()
            self.diagnostics.report(ERROR, f"{INACTIVE}: {problem}")
            return FAILURE
        level, message = self.diagnostics.state
        if level == OK or message.startswith(INACTIVE):
            self.diagnostics.report(WARN, WAITING, expected=True)
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.inputs.close()
        self.diagnostics.report(OK, INACTIVE)
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._undo_configuration()
        self.diagnostics.report(OK, UNCONFIGURED)
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.autostart.unmanaged_since = None
        if self.inputs.is_open:
            self.inputs.close()
        self._undo_configuration()
        self.diagnostics.report(OK, "shut down; send SIGINT or SIGTERM to end the process")
        return SUCCESS

    def _undo_configuration(self) -> None:
        if self._snapshot is not None:
            self._snapshot.restore()

    def _run_step(self, step: Callable[[], Any]) -> str | None:
        """Run step() and return its error message, or None. Log the traceback of unexpected errors once."""
        try:
            with convert_os_errors():
                step()
        except InputError as error:
            return str(error)
        except Exception as error:  # torch and its drivers raise many types
            problem = f"{type(error).__name__}: {error}"
            if not self.diagnostics.state[1].endswith(problem):
                self.get_logger().error(traceback.format_exc())
            return problem
        return None


class NodeSnapshot:
    """Snapshot of the attributes and ROS entities of a node."""

    def __init__(self, node: LidarNode):
        self.node = node
        self.attributes = set(vars(node))
        self.sources = [*node.diagnostics.sources]
        self.entities = [entity for kind in ENTITIES for entity in getattr(node, kind)]

    def restore(self) -> None:
        """Remove the attributes, inputs, outputs and ROS entities that were created after the snapshot."""
        for name in set(vars(self.node)) - self.attributes:
            delattr(self.node, name)
        self.node.inputs.items = []
        self.node.outputs.clear()
        self.node.diagnostics.sources = [*self.sources]
        self.node.diagnostics.reset()
        kept_entities = [*self.entities, get_clock_subscription(self.node)]
        for kind, destroy in ENTITIES.items():
            for entity in [e for e in getattr(self.node, kind) if e not in kept_entities]:
                destroy(self.node, entity)
        release_memory()


def release_memory() -> None:
    """Return unused memory of Python, torch and the C library to the operating system and to CUDA."""
    gc.collect()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # exists in glibc only
    if trim is not None:
        trim(0)
