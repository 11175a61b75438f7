"""Start a node: block signals first, then compile, then ROS. Every executable enters here.

A thread that a library starts before the signals are blocked, such as one of NumPy's OpenBLAS,
never blocks them, and they end the process there. So this module imports the standard library
only, and each function its own imports.
"""

from __future__ import annotations

import os
import re
import signal
import sys
from contextlib import suppress
from itertools import pairwise
from time import perf_counter
from typing import TYPE_CHECKING

from lidar_perception.nodes import load_node_class, require_rclpy

if TYPE_CHECKING:
    from lidar_perception.nodes.runtime import LidarNode
    from lidar_perception.nodes.stopping import Stop

STOP_SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM})


def help_text(name: str) -> str:
    """What --help prints: how to start the node, and its parameters."""
    from lidar_perception.nodes.known import node_parameters
    from lidar_perception.param_fields import describe_fields
    lines = [f"Usage: {name} --ros-args [-p PARAMETER:=VALUE] [-r FROM:=TO] [--params-file YAML]",
             "", "Parameters:"]
    return "\n".join([*lines, *describe_fields(node_parameters(name))])


def run(name: str, arguments: list[str]) -> int:
    """Run a node until SIGINT or SIGTERM (exit code 0), or until it is done. 2: it cannot start."""
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    begin = perf_counter()
    from lidar_perception.runs.memory import keep_freed_memory
    from lidar_perception.runs.threads import default_to_one_thread
    default_to_one_thread()  # or nodes that share few cores stand in each other's way
    keep_freed_memory()
    from lidar_perception.nodes.stopping import Stop
    stop = Stop(STOP_SIGNALS)
    if {"-h", "--help"} & set(arguments[1:]):
        try:
            print(help_text(name), flush=True)
        except BrokenPipeError:  # `| head`: Python shall not try again at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    from lidar_perception.nodes.shared_memory import fed_by_a_driver, use_large_shared_memory
    use_large_shared_memory(fed_by_a_driver(arguments))
    from lidar_perception.types import InputError
    try:
        require_rclpy()
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    from rclpy.logging import get_logger

    from lidar_perception.runs.compiling import lock_compilation, report_compilation
    say = get_logger(_logger_name(arguments)).info
    with report_compilation(say):
        node_class = load_node_class(name)
        if warm_up := getattr(sys.modules[node_class.__module__], "warm_up", None):
            with lock_compilation(say):
                warm_up()
    return _spin(node_class, arguments, begin, stop)


def _logger_name(arguments: list[str]) -> str:
    """Return the name under which ROS logs a node with these arguments, before there is the node.

    The name after remapping, with its namespace; without a rule that of the executable.
    """
    rules = [b.rpartition(":__")[2].removeprefix("__").partition(":=")
             for a, b in pairwise(arguments) if a in ("-r", "--remap")]
    given = {key: value for key, _, value in rules if re.fullmatch(r"[A-Za-z_/][\w/]*", value)}
    name = given.get("node") or given.get("name") or arguments[0]
    return ".".join([*filter(None, given.get("ns", "").split("/")), name])


def _misspelt_sections(arguments: list[str], node: str) -> list[str]:
    """Return a line for each section of the parameter files that may be meant for this node."""
    from lidar_perception.nodes.param_files import unknown_nodes
    from lidar_perception.types import InputError
    lines = []
    for path in [b for a, b in pairwise(arguments) if a == "--params-file"]:
        with suppress(InputError):  # too large, say; rcl has read it all the same
            lines += unknown_nodes(path, [node], only_like=True)
    return lines


def _leave(node: LidarNode) -> None:
    """End the process beside work that goes on, such as a compilation."""
    import rclpy
    with suppress(Exception):
        node.destroy_node()
        rclpy.try_shutdown()
    os._exit(0)


def _spin(node_class: type, arguments: list[str], begin: float, stop: Stop) -> int:
    """Make the node and spin it. begin: perf_counter() at the start of the process."""
    import rclpy
    from rclpy.exceptions import NameValidationException, ParameterException
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.impl.implementation_singleton import rclpy_implementation
    from rclpy.logging import get_logger
    from rclpy.signals import SignalHandlerOptions

    from lidar_perception.nodes.known import misspelt
    from lidar_perception.runs.files import convert_os_errors
    from lidar_perception.types import InputError

    RCLError = rclpy_implementation.RCLError
    UnknownROSArgsError = rclpy_implementation.UnknownROSArgsError
    log = get_logger(_logger_name(arguments))
    node, code = None, 1
    kept: BaseException | None = None  # and with it what a refused node has made
    try:
        stop.react = lambda: None  # DDS has to be taken down from here on: see stop.asked
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        with convert_os_errors():
            node = node_class()
        stop.react = lambda: node.stop.set_result(None)
        if not node.writes_files:
            stop.leave = lambda: _leave(node)
        if stop.asked:
            node.stop.set_result(None)
        for line in [*misspelt(n for n in node._parameter_overrides if not node.has_parameter(n)),
                     *_misspelt_sections(arguments, node.get_name())]:
            node.get_logger().warning(line)  # before anything that takes long
        if not node.stop.done():
            node.start()
        if not node.stop.done():
            if node.is_ready():
                node.get_logger().info("ready: code loaded and warmed up in "
                                       f"{perf_counter() - begin:.1f} s")
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            node.spin(executor)
        code = 0
    except UnknownROSArgsError as error:
        log.fatal(f"unknown after --ros-args: {error}")
        kept, code = error, 2
    except (InputError, ValueError, ParameterException, NameValidationException, RCLError) as error:
        log.fatal(" ".join(str(error).split()))
        kept, code = error, 2
    finally:
        stop.closing()
        if node is not None:
            try:
                node.close()
            except InputError as error:  # what it holds cannot be written
                node.get_logger().fatal(str(error))
                code = code or 1
        stop.closed(code)
        if node is not None:
            node.destroy_node()
        del kept  # DDS is taken down here, where a hang is cut short
        rclpy.try_shutdown()
    return code


if __name__ == "__main__":
    code = run(sys.argv[1], sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # DDS is down; to unload torch, too, would take two seconds on busy cores
