"""Activation of a lifecycle node without a lifecycle manager, and a warning if no manager activates it."""

from __future__ import annotations

from time import monotonic
from typing import Any

from rclpy.lifecycle import TransitionCallbackReturn

from lidar_perception.nodes.diagnostics import OK, WARN

SUCCESS = TransitionCallbackReturn.SUCCESS
CHECK_PERIOD_S = 1.0
MIN_RETRY_PERIOD_S = 5.0
RETRY_FACTOR = 10.0  # ratio of the retry period to the duration of an attempt
MANAGER_TIMEOUT_S = 10.0  # time after the start for a lifecycle manager to send its first request
UNCONFIGURED = "not configured"


class Autostart:
    """Activates a node, and retries after a failure because a missing file may have appeared.

    If the parameter autostart is false, a lifecycle manager activates the node. A diagnostic warns
    if no request of a manager arrives, for example after a restart of the node.

    Args:
        node: the node.
        inputs: names of its inputs below ~/input; a publisher on one of them means that the node
            should be active.
    """

    def __init__(self, node: Any, inputs: tuple[str, ...]):
        self.node, self.inputs = node, inputs
        self.retry_at: float | None = None  # monotonic time of the next attempt
        self.unmanaged_since: float | None = None  # monotonic time of the start; None once a request has arrived
        node.add_steady_timer(CHECK_PERIOD_S, self.check)

    def start(self) -> None:
        """Activate the node, or wait for a lifecycle manager."""
        node = self.node
        if not node.node_params.autostart:
            node.get_logger().info(f"{UNCONFIGURED}: waiting for a lifecycle manager, because autostart is false")
            self.unmanaged_since = monotonic()
            return
        begin = monotonic()
        is_configured = node.get_state_label() == "inactive" or node.trigger_configure() == SUCCESS
        if is_configured and node.trigger_activate() == SUCCESS:
            if self.retry_at is not None:
                node.get_logger().info("ready")
            self.retry_at = None
        else:
            now = monotonic()
            self.retry_at = now + max(MIN_RETRY_PERIOD_S, RETRY_FACTOR * (now - begin))

    def check(self) -> None:
        """Retry a failed start, and report a missing lifecycle manager."""
        if self.retry_at is not None and monotonic() > self.retry_at:
            self.start()
        if self.unmanaged_since is not None and monotonic() - self.unmanaged_since > MANAGER_TIMEOUT_S:
            self.node.diagnostics.report(*self._describe_missing_manager())

    def _describe_missing_manager(self) -> tuple[bytes, str]:
        """Return the level and message for a node that has not received a transition request."""
        topics = [self.node.resolve_topic_name(f"~/input/{name}") for name in self.inputs]
        if not (active_topics := [topic for topic in topics if self.node.count_publishers(topic)]):
            return OK, UNCONFIGURED
        return WARN, (
            f"{UNCONFIGURED} by any lifecycle manager, but there is a publisher on "
            f"{active_topics[0]}: a manager does not notice that a node was restarted; "
            f"restart the manager, or run `ros2 lifecycle set {self.node.get_fully_qualified_name()} configure`, "
            "then activate"
        )
