"""Managed nodes: a lifecycle manager, such as Nav2's, configures, activates and ends them."""

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

from lidar_perception.nodes.runtime import ERROR, OK, WAITING, WARN, LidarNode
from lidar_perception.nodes.transforms import Transforms
from lidar_perception.runs.compiling import report_compilation
from lidar_perception.runs.files import convert_os_errors
from lidar_perception.types import InputError

SUCCESS, FAILURE = TransitionCallbackReturn.SUCCESS, TransitionCallbackReturn.FAILURE
RETRY_PERIOD = 5.0  # seconds at least, and RETRY_SHARE times as long as an attempt takes
RETRY_SHARE = 10.0
UNASKED = 10.0  # seconds after its start, in which a lifecycle manager asks a node for something
UNCONFIGURED, INACTIVE = "not configured", "not active"
ENTITIES: dict[str, Any] = {
    "publishers": Node.destroy_publisher, "subscriptions": Node.destroy_subscription,
    "clients": Node.destroy_client, "services": Node.destroy_service,
    "timers": Node.destroy_timer, "guards": Node.destroy_guard_condition}


class ManagedNode(LifecycleNodeMixin, LidarNode):
    """A LidarNode with the states of a managed node
    (https://design.ros2.org/articles/node_lifecycle.html).

    A node says in configure() what it needs, and knows nothing else of its states: its inputs are
    subscribed to while it is active, and a cleanup forgets every attribute that configure() has
    set and destroys every publisher, timer and so on that it has made, so that the memory of a
    network is free again. With the parameter autostart the node goes to active by itself, and
    where that fails tries again, as a file that is missing may appear. Without it a node that
    nobody asks for anything, as of a manager that has not seen it start again, says so.
    """

    waits_for: ClassVar[tuple[str, ...]] = ("points",)  # the ~/input/... that its work comes from

    def __init__(self, name: str, params: Any, robot: Any, **options: Any):
        LidarNode.__init__(self, name, params, robot, **options)
        LifecycleNodeMixin.__init__(self)
        self.active = False
        self.state = (OK, UNCONFIGURED)
        self._retry_at: float | None = None
        self._unasked_since: float | None = None  # monotonic; None once it was asked
        self._own: set[str] = set()  # attributes that a cleanup leaves
        self._kept: list[Any] = []  # publishers and so on, likewise
        change = self._service_change_state.callback
        self._service_change_state.callback = lambda *call: self._change(change, *call)

    def configure(self) -> None:
        """Make outputs and inputs, and load what is needed. InputError if it is not to be had."""
        raise NotImplementedError

    def _configure(self) -> None:
        self.transforms = Transforms(self)
        with report_compilation(self.get_logger().info):
            self.configure()

    def is_ready(self) -> bool:
        return self.state_label() == "active"

    def start(self) -> None:
        if not self.robot.autostart:
            self.get_logger().info(f"{UNCONFIGURED}: waits for a lifecycle manager, as autostart "
                                   "is false")
            self._unasked_since = monotonic()
            return
        begin = monotonic()
        if (self.state_label() == "inactive" or self.trigger_configure() == SUCCESS) and (
                self.trigger_activate() == SUCCESS):
            if self._retry_at is not None:
                self.get_logger().info("ready")
            self._retry_at = None
        else:
            now = monotonic()
            self._retry_at = now + max(RETRY_PERIOD, RETRY_SHARE * (now - begin))

    def _tick(self) -> None:
        if self._retry_at is not None and monotonic() > self._retry_at:
            self.start()
        if self._unasked_since is not None and monotonic() - self._unasked_since > UNASKED:
            self.report(*self._unasked())
        super()._tick()

    def _unasked(self) -> tuple[bytes, str]:
        """The state of a node that was never asked for a transition."""
        topics = [self.resolve_topic_name(f"~/input/{name}") for name in self.waits_for]
        if not (sent := [topic for topic in topics if self.count_publishers(topic)]):
            return OK, UNCONFIGURED
        name = self.get_fully_qualified_name()
        return WARN, (f"{UNCONFIGURED}, and nobody has asked for it, but there is a publisher on "
                      f"{sent[0]}: a lifecycle manager does not see that a node was started again; "
                      f"let it begin anew, or `ros2 lifecycle set {name} configure`, then activate")

    def _change(self, change: Callable, request: Any, response: Any) -> Any:
        """A change that the present state does not allow is refused; rclpy would end the node."""
        possible = [key for number, label, *_ in self._state_machine.available_transitions
                    for key in (number, label)]
        wanted = request.transition.label or request.transition.id
        if wanted in possible:
            self._retry_at = None
            return change(request, response)
        self.get_logger().error(
            f"transition {wanted} is asked for, but the node is {self.state_label()}" + (
                "; a node that a lifecycle manager is to drive needs the parameter autostart false"
                if self.robot.autostart else ""))
        response.success = False
        return response

    def destroy_node(self) -> None:
        """With the state machine, which rclpy leaves, and with it the node in the graph, until it
        is collected as garbage."""
        super().destroy_node()
        self._state_machine.destroy_when_not_in_use()

    def state_label(self) -> str:
        """unconfigured, inactive, active or finalized; configuring and so on in between."""
        return self._state_machine.current_state[1]

    def publish_diagnostics(self) -> None:
        self.counts["lifecycle"] = self.state_label()
        super().publish_diagnostics()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._unasked_since = None
        self._own = set(vars(self))
        self._kept = [entity for kind in ENTITIES for entity in getattr(self, kind)]
        if self._retry_at is None:
            self.report(WARN, "configuring", expected=True)
        before = self.state
        if problem := self._problem_of(self._configure):
            self._forget_configuration()
            self.report(ERROR, f"{UNCONFIGURED}, so this node publishes nothing: {problem}")
            return FAILURE
        if self.state == before:
            self.state = (OK, INACTIVE)
        return SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self.active = True
        if problem := self._problem_of(lambda: [made.open() for made in self.inputs]):
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
        self._unasked_since = None
        if self.active:
            self._deactivate()
        if self.inputs:
            self._forget_configuration()
        self.report(OK, "shut down; the process ends at SIGINT or SIGTERM")
        return SUCCESS

    def _problem_of(self, step: Callable[[], Any]) -> str | None:
        """What step() fails for; what is no InputError is logged in full, once."""
        try:
            with convert_os_errors():
                step()
        except InputError as error:
            return str(error)
        except Exception as error:  # of torch and its drivers, say: the node lives to tell
            problem = f"{type(error).__name__}: {error}"
            if not self.state[1].endswith(problem):
                self.get_logger().error(traceback.format_exc())
            return problem
        return None

    def _deactivate(self) -> None:
        self.active = False
        for made in self.inputs:
            made.close()

    def _forget_configuration(self) -> None:
        for name in set(vars(self)) - self._own:
            delattr(self, name)
        self.forget()
        # rclpy's own of /clock, which it makes whenever use_sim_time is set
        kept = [*self._kept, self._time_source._clock_sub]
        for kind, destroy in ENTITIES.items():
            for entity in [e for e in getattr(self, kind) if e not in kept]:
                destroy(self, entity)
        give_back_memory()


def give_back_memory() -> None:
    """What Python, torch and the C library have free, to the operating system and to CUDA."""
    gc.collect()
    torch = sys.modules.get("torch")
    if torch is not None and torch.cuda.is_initialized():
        torch.cuda.empty_cache()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # glibc
    if trim is not None:
        trim(0)
