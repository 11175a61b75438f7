"""Entry point of all node executables: block signals, compile, then start ROS.

Threads that a library starts before the signals are blocked, such as those of OpenBLAS, do not
block them, and a signal would end the process there. So this module imports only the standard
library at its top, and the functions import the rest.
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
    """Return the text of --help: usage and parameters of a node."""
    from lidar_perception.nodes.node_parameters import find_node_parameters
    from lidar_perception.param_fields import describe_fields
    lines = [f"Usage: {name} --ros-args [-p PARAMETER:=VALUE] [-r FROM:=TO] [--params-file YAML]",
             "", "Parameters:"]
    return "\n".join([*lines, *describe_fields(find_node_parameters(name))])


def run(name: str, arguments: list[str]) -> int:
    """Run a node until it is done or gets SIGINT or SIGTERM; return its exit code.

    The code is 0 after a signal, and 2 if the node cannot start.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    begin = perf_counter()
    from lidar_perception.runs.memory import keep_freed_memory
    from lidar_perception.runs.threads import default_to_one_thread
    default_to_one_thread()  # nodes share the cores
    keep_freed_memory()
    from lidar_perception.nodes.stopping import Stop
    stop = Stop(STOP_SIGNALS)
    if {"-h", "--help"} & set(arguments[1:]):
        try:
            print(help_text(name), flush=True)
        except BrokenPipeError:  # `| head`: keep Python from flushing again at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    from lidar_perception.nodes.shared_memory import is_fed_by_driver, use_large_shared_memory
    use_large_shared_memory(is_fed_by_driver(arguments))
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
    """Return the logger name of a node with these arguments before the node exists.

    It is the remapped name of the node, or that of the executable, with the namespace.
    """
    rules = [b.rpartition(":__")[2].removeprefix("__").partition(":=")
             for a, b in pairwise(arguments) if a in ("-r", "--remap")]
    given = {key: value for key, _, value in rules if re.fullmatch(r"[A-Za-z_/][\w/]*", value)}
    name = given.get("node") or given.get("name") or arguments[0]
    return ".".join([*filter(None, given.get("ns", "").split("/")), name])


def _find_misspelt_sections(arguments: list[str], node: str) -> list[str]:
    """Return a line for each section of the parameter files whose name is close to this node's."""
    from lidar_perception.nodes.param_files import describe_unknown_nodes
    from lidar_perception.types import InputError
    lines = []
    for path in [b for a, b in pairwise(arguments) if a == "--params-file"]:
        with suppress(InputError):  # for example too large for us; rcl has read it
            lines += describe_unknown_nodes(path, [node], only_similar=True)
    return lines


def _exit_process(node: LidarNode) -> None:
    """End the process while its work, such as a compilation, still runs."""
    import rclpy
    with suppress(Exception):
        node.destroy_node()
        rclpy.try_shutdown()
    os._exit(0)


def _spin(node_class: type, arguments: list[str], begin: float, stop: Stop) -> int:
    """Create a node and spin it; return the exit code.

    begin is the perf_counter() at the start of the process.
    """
    import rclpy
    from rclpy.exceptions import NameValidationException, ParameterException
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.logging import get_logger
    from rclpy.signals import SignalHandlerOptions

    from lidar_perception.nodes.node_parameters import describe_misspelt_parameters
    from lidar_perception.nodes.rclpy_compat import (
        RCLError,
        UnknownROSArgsError,
        parameter_overrides,
    )
    from lidar_perception.runs.files import convert_os_errors
    from lidar_perception.types import InputError

    log = get_logger(_logger_name(arguments))
    node, code = None, 1
    kept: BaseException | None = None  # keeps the entities of a node that failed to start
    try:
        stop.on_signal = lambda: None  # DDS must be shut down from here on, see stop.requested
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        with convert_os_errors():
            node = node_class()
        stop.on_signal = lambda: node.stop.set_result(None)
        if not node.writes_files:
            stop.force_exit = lambda: _exit_process(node)
        if stop.requested:
            node.stop.set_result(None)
        undeclared = [name for name in parameter_overrides(node) if not node.has_parameter(name)]
        for line in [*describe_misspelt_parameters(undeclared),
                     *_find_misspelt_sections(arguments, node.get_name())]:
            node.get_logger().warning(line)  # before any long work
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
        log.fatal(f"unknown argument after --ros-args: {error}")
        kept, code = error, 2
    except (InputError, ValueError, ParameterException, NameValidationException, RCLError) as error:
        log.fatal(" ".join(str(error).split()))
        kept, code = error, 2
    finally:
        stop.begin_closing()
        if node is not None:
            try:
                node.close()
            except InputError as error:  # its results cannot be written
                node.get_logger().fatal(str(error))
                code = code or 1
        stop.finish_closing(code)
        if node is not None:
            node.destroy_node()
        del kept  # shuts down DDS here, where the guard ends a hang
        rclpy.try_shutdown()
    return code


if __name__ == "__main__":
    code = run(sys.argv[1], sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # DDS is down; unloading torch would take seconds
