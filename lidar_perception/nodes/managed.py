"""Base class of lifecycle nodes, which a lifecycle manager such as that of Nav2 can drive."""

from __future__ import annotations

import ctypes
import gc
import sys
import traceback
from collections.abc import Callable
from time import monotonic
from typing import Any, ClassVar

from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node

from lidar_perception.nodes.rclpy_compat import (
    allowed_transitions,
    clock_subscription,
    destroy_state_machine,
    state_label,
    wrap_change_state,
)
from lidar_perception.nodes.runtime import ERROR, OK, WAITING, WARN, LidarNode
from lidar_perception.nodes.transforms import Transforms
from lidar_perception.runs.compiling import report_compilation
from lidar_perception.runs.files import convert_os_errors
from lidar_perception.types import InputError

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
MIN_RETRY_PERIOD_S = 5.0
RETRY_FACTOR = 10.0  # ratio of the retry period to the duration of an attempt
MANAGER_TIMEOUT_S = 10.0  # time after the start for a lifecycle manager to send its first request
UNCONFIGURED, INACTIVE = "not configured", "not active"
ENTITIES: dict[str, Any] = {
    "publishers": Node.destroy_publisher,
    "subscriptions": Node.destroy_subscription,
    "clients": Node.destroy_client,
    "services": Node.destroy_service,
    "timers": Node.destroy_timer,
    "guards": Node.destroy_guard_condition,
}


class ManagedNode(LifecycleNodeMixin, LidarNode):
    """A LidarNode with the states of a managed node.

    See https://design.ros2.org/articles/node_lifecycle.html. A subclass only implements
    configure(). Its inputs are subscribed to while the node is active. A cleanup deletes every
    attribute that configure() has set and destroys every publisher, timer and so on that it has
    made, which frees the memory of a network. With the parameter autostart the node activates
    itself and retries after a failure, as a missing file may appear. Without it, the node warns if
    no lifecycle manager has requested anything, for example after a restart.
    """

    waits_for: ClassVar[tuple[str, ...]] = ("points",)  # names of the inputs below ~/input

    def __init__(self, name: str, params: Any, node_params: Any, **options: Any):
        LidarNode.__init__(self, name, params, node_params, **options)
        LifecycleNodeMixin.__init__(self)
        self.active = False
        self.state = (OK, UNCONFIGURED)
        self._retry_at: float | None = None
        self._unmanaged_since: float | None = None  # monotonic time of the start; None once a request has arrived
        self._own_attributes: set[str] = set()  # attributes that a cleanup keeps
        self._own_entities: list[Any] = []  # publishers, timers and other entities that a cleanup keeps
        wrap_change_state(self, self._change)

    def configure(self) -> None:
        """Make outputs and inputs, and load networks.

        Raises:
            InputError: a file is missing or unusable.
        """
        raise NotImplementedError

    def _configure(self) -> None:
        self.transforms = Transforms(self)
        with report_compilation(self.get_logger().info):
            self.configure()

    def is_ready(self) -> bool:
        return self.state_label() == "active"

    def start(self) -> None:
        if not self.node_params.autostart:
            self.get_logger().info(f"{UNCONFIGURED}: waiting for a lifecycle manager, because autostart is false")
            self._unmanaged_since = monotonic()
            return
        begin = monotonic()
        if (self.state_label() == "inactive" or self.trigger_configure() == SUCCESS) and (
            self.trigger_activate() == SUCCESS
        ):
            if self._retry_at is not None:
                self.get_logger().info("ready")
            self._retry_at = None
        else:
            now = monotonic()
            self._retry_at = now + max(MIN_RETRY_PERIOD_S, RETRY_FACTOR * (now - begin))

    def _tick(self) -> None:
        if self._retry_at is not None and monotonic() > self._retry_at:
            self.start()
        since = self._unmanaged_since
        if since is not None and monotonic() - since > MANAGER_TIMEOUT_S:
            self.report(*self._describe_unmanaged())
        super()._tick()

    def _describe_unmanaged(self) -> tuple[bytes, str]:
        """Return the diagnostic of a node that has had no transition request."""
        topics = [self.resolve_topic_name(f"~/input/{name}") for name in self.waits_for]
        if not (published := [topic for topic in topics if self.count_publishers(topic)]):
            return OK, UNCONFIGURED
        name = self.get_fully_qualified_name()
        return WARN, (
            f"{UNCONFIGURED} by any lifecycle manager, but there is a publisher on "
            f"{published[0]}: a manager does not notice that a node was restarted; "
            f"restart the manager, or run `ros2 lifecycle set {name} configure`, then "
            "activate"
        )

    def _change(self, change: Callable, request: Any, response: Any) -> Any:
        """Refuse a transition that the current state does not allow; rclpy would end the node."""
        transition = request.transition.label or request.transition.id
        if transition in allowed_transitions(self):
            self._retry_at = None
            return change(request, response)
        self.get_logger().error(
            f"transition {transition} is not possible: the node is {self.state_label()}"
            + (
                "; set the parameter autostart to false for use with a lifecycle manager"
                if self.node_params.autostart
                else ""
            )
        )
        response.success = False
        return response

    def destroy_node(self) -> None:
        super().destroy_node()
        destroy_state_machine(self)

    def state_label(self) -> str:
        """Return the lifecycle state, such as "inactive", or "configuring" in a transition."""
        return state_label(self)

    def publish_diagnostics(self) -> None:
        self.counts["lifecycle"] = self.state_label()
        super().publish_diagnostics()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._unmanaged_since = None
        self._own_attributes = set(vars(self))
        self._own_entities = [entity for kind in ENTITIES for entity in getattr(self, kind)]
        if self._retry_at is None:
            self.report(WARN, "configuring", expected=True)
        before = self.state
        if problem := self._find_problem(self._configure):
            self._forget_configuration()
            self.report(ERROR, f"{UNCONFIGURED}, so this node publishes nothing: {problem}")
            return FAILURE
        if self.state == before:
            self.state = (OK, INACTIVE)
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = True
        if problem := self._find_problem(lambda: [source.open() for source in self.inputs]):
            self._deactivate()
            self.report(ERROR, f"{INACTIVE}: {problem}")
            return FAILURE
        if self.state[0] == OK or self.state[1].startswith(INACTIVE):
            self.report(WARN, WAITING, expected=True)
        return SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._deactivate()
        self.report(OK, INACTIVE)
        return SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._forget_configuration()
        self.report(OK, UNCONFIGURED)
        return SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._unmanaged_since = None
        if self.active:
            self._deactivate()
        if self.inputs:
            self._forget_configuration()
        self.report(OK, "shut down; send SIGINT or SIGTERM to end the process")
        return SUCCESS

    def _find_problem(self, step: Callable[[], Any]) -> str | None:
        """Run step() and return its error message; log the traceback of unexpected errors once."""
        try:
            with convert_os_errors():
                step()
        except InputError as error:
            return str(error)
        except Exception as error:  # torch and its drivers raise many types
            problem = f"{type(error).__name__}: {error}"
            if not self.state[1].endswith(problem):
                self.get_logger().error(traceback.format_exc())
            return problem
        return None

    def _deactivate(self) -> None:
        self.active = False
        for source in self.inputs:
            source.close()

    def _forget_configuration(self) -> None:
        for name in set(vars(self)) - self._own_attributes:
            delattr(self, name)
        self.reset_state()
        kept = [*self._own_entities, clock_subscription(self)]
        for kind, destroy in ENTITIES.items():
            for entity in [e for e in getattr(self, kind) if e not in kept]:
                destroy(self, entity)
        release_memory()


def release_memory() -> None:
    """Return free memory of Python, torch and the C library to the operating system and to CUDA."""
    gc.collect()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # exists in glibc only
    if trim is not None:
        trim(0)
