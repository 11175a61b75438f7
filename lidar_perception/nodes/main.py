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
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from contextlib import suppress
from itertools import pairwise
from time import perf_counter
from typing import TYPE_CHECKING, Any

from lidar_perception.nodes import NODES, load_node_class, require_rclpy

if TYPE_CHECKING:
    from lidar_perception.nodes.runtime import LidarNode
    from lidar_perception.nodes.stopping import Stop

STOP_SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM})


def help_text(name: str) -> str:
    """Return the text of --help: usage and parameters of a node."""
    from lidar_perception.nodes.node_parameters import find_node_parameters
    from lidar_perception.param_fields import describe_fields

    lines = [f"Usage: {name} --ros-args [-p PARAMETER:=VALUE] [-r FROM:=TO] [--params-file YAML]", "", "Parameters:"]
    return "\n".join([*lines, *describe_fields(find_node_parameters(name))])


def run(name: str, arguments: list[str]) -> int:
    """Run a node until it is done or gets SIGINT or SIGTERM; return its exit code.

    The code is 0 after a signal, and 2 if the node cannot start.

    Args:
        name: executable of the node.
        arguments: the same name, then arguments for ROS. After `---` may come another node for
            the same process, and last, without a name, arguments of the process, such as
            `--ros-args --log-level debug`.
    """
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    begin = perf_counter()
    from lidar_perception.runs.memory import keep_freed_memory
    from lidar_perception.runs.threads import default_to_one_thread

    default_to_one_thread()  # because several nodes share the cores
    keep_freed_memory()
    from lidar_perception.nodes.stopping import Stop

    stop = Stop(STOP_SIGNALS)
    if {"-h", "--help"} & set(arguments[1:]):
        try:
            print(help_text(name), flush=True)
        except BrokenPipeError:  # output piped to `head`: keep Python from flushing again at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    nodes, shared = split_arguments(arguments)
    from lidar_perception.nodes.shared_memory import is_fed_by_driver, use_large_shared_memory

    use_large_shared_memory(any(map(is_fed_by_driver, nodes)))
    from lidar_perception.types import InputError

    try:
        require_rclpy()
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    from rclpy.logging import get_logger

    from lidar_perception.runs.compiling import report_compilation

    say = get_logger(_logger_name(nodes[0])).info
    with report_compilation(say):
        classes = [load_node_class(each[0]) for each in nodes]
    if len(nodes) == 1 and not shared:
        return _spin(classes[0], nodes[0], begin, stop)
    return _spin_together(list(zip(classes, nodes)), shared, begin, stop)


def split_arguments(arguments: list[str]) -> tuple[list[list[str]], list[str]]:
    """Return the arguments of each node, and those of the process."""
    from lidar_perception.nodes.graph import SEPARATOR

    parts: list[list[str]] = [[]]
    for word in arguments:
        if word == SEPARATOR:
            parts.append([])
        else:
            parts[-1].append(word)
    nodes = [part for part in parts if part and part[0] in NODES]
    return nodes, [word for part in parts if part not in nodes for word in part]


def _logger_name(arguments: list[str]) -> str:
    """Return the logger name of a node with these arguments before the node exists.

    It is the remapped name of the node, or that of the executable, with the namespace.
    """
    rules = [
        b.rpartition(":__")[2].removeprefix("__").partition(":=")
        for a, b in pairwise(arguments)
        if a in ("-r", "--remap")
    ]
    given = {key: value for key, _, value in rules if re.fullmatch(r"[A-Za-z_/][\w/]*", value)}
    name = given.get("node") or given.get("name") or arguments[0]
    return ".".join([*filter(None, given.get("ns", "").split("/")), name])


def _find_misspelt_sections(arguments: list[str], node: str) -> list[str]:
    """Return a line for each section of the parameter files whose name is close to this node's."""
    from lidar_perception.nodes.param_files import describe_unknown_nodes
    from lidar_perception.types import InputError

    lines = []
    for path in [b for a, b in pairwise(arguments) if a == "--params-file"]:
        with suppress(InputError):  # for example a file too large for us; rcl has already read it
            lines += describe_unknown_nodes(path, [node], only_similar=True)
    return lines


def _exit_process(nodes: list[LidarNode]) -> None:
    """End the process while its work, such as a compilation, still runs."""
    import rclpy
    from rclpy.logging import LoggingSeverity

    with suppress(Exception):
        for node in nodes:
            node.get_logger().set_level(LoggingSeverity.FATAL)  # the running work fails without its node
            node.destroy_node()
        rclpy.try_shutdown()
    os._exit(0)


def _spin(node_class: type, arguments: list[str], begin: float, stop: Stop) -> int:
    """Create a node and spin it; return the exit code.

    begin is the perf_counter() at the start of the process.
    """
    return _run_nodes([(node_class, arguments, {})], arguments, begin, stop)


def _spin_together(nodes: list[tuple[type, list[str]]], shared: list[str], begin: float, stop: Stop) -> int:
    """Create linked nodes and spin each in its own thread; return the exit code.

    shared: arguments for ROS that are not of one of the nodes.
    """
    from lidar_perception.nodes.links import Links

    links = Links()
    return _run_nodes(
        [(node_class, arguments, {"cli_args": arguments[1:], "links": links}) for node_class, arguments in nodes],
        shared,
        begin,
        stop,
    )


def _run_nodes(given: list[tuple[type, list[str], dict[str, Any]]], shared: list[str], begin: float, stop: Stop) -> int:
    """Create nodes of these classes, arguments and options, spin them, and return the exit code."""
    import rclpy
    from rclpy.exceptions import NameValidationException, ParameterException
    from rclpy.logging import get_logger
    from rclpy.signals import SignalHandlerOptions

    from lidar_perception.nodes.rclpy_compat import RCLError, UnknownROSArgsError
    from lidar_perception.runs.files import convert_os_errors
    from lidar_perception.types import InputError

    log = get_logger(_logger_name(given[0][1]))
    nodes: list[LidarNode] = []
    code = 1
    kept: BaseException | None = None  # keeps the entities of a node that failed to start

    def end() -> None:
        for node in nodes:
            node.stop.set_result(None)

    try:
        stop.on_signal = lambda: None  # a signal must now let DDS shut down, see stop.requested
        rclpy.init(args=shared, signal_handler_options=SignalHandlerOptions.NO)
        for node_class, arguments, options in given:
            log = get_logger(_logger_name(arguments))
            with convert_os_errors():
                nodes.append(node_class(**options))
        stop.on_signal = end
        if not any(node.writes_files for node in nodes):
            stop.force_exit = lambda: _exit_process(nodes)
        if stop.requested:
            end()
        if len(nodes) == 1:
            _spin_node(nodes[0], given[0][1], begin)
        else:
            with ThreadPoolExecutor(len(nodes)) as pool:
                spinning = [
                    pool.submit(_spin_node, node, arguments, begin) for node, (_, arguments, _) in zip(nodes, given)
                ]
                if any(future.exception() for future in wait(spinning, None, FIRST_EXCEPTION).done):
                    end()
            for node, future in zip(nodes, spinning):
                log = node.get_logger()
                future.result()
        code = 0
    except UnknownROSArgsError as error:
        log.fatal(f"unknown argument after --ros-args: {error}")
        kept, code = error, 2
    except (InputError, ValueError, ParameterException, NameValidationException, RCLError) as error:
        log.fatal(" ".join(str(error).split()))
        kept, code = error, 2
    finally:
        stop.begin_closing()
        for node in nodes:
            try:
                node.close()
            except InputError as error:  # the results cannot be written
                node.get_logger().fatal(str(error))
                code = code or 1
        stop.finish_closing(code)
        for node in nodes:
            node.destroy_node()
        del kept  # DDS shuts down; the guard ends the process if it hangs
        rclpy.try_shutdown()
    return code


def _spin_node(node: LidarNode, arguments: list[str], begin: float) -> None:
    """Start a node and spin it until it is to stop."""
    from rclpy.executors import SingleThreadedExecutor

    from lidar_perception.nodes.node_parameters import describe_misspelt_parameters
    from lidar_perception.nodes.rclpy_compat import parameter_overrides

    undeclared = [name for name in parameter_overrides(node) if not node.has_parameter(name)]
    for line in [*describe_misspelt_parameters(undeclared), *_find_misspelt_sections(arguments, node.get_name())]:
        node.get_logger().warning(line)  # logged before any long work
    if not node.stop.done():
        node.start()
    if not node.stop.done():
        if node.is_ready():
            node.get_logger().info(f"ready: code loaded and warmed up in {perf_counter() - begin:.1f} s")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.spin(executor)


if __name__ == "__main__":
    code = run(sys.argv[1], sys.argv[1:])
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # DDS is shut down; skip unloading torch, which takes seconds
