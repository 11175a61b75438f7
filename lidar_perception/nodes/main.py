"""Entry point of all node executables: block signals, compile, then start ROS.

Signals must be blocked before a library such as OpenBLAS starts threads. Otherwise these threads
would not block them, and a signal would end the process. This module therefore imports only the
standard library at its top; the functions import everything else.
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


def make_help_text(name: str) -> str:
    """Return the text of --help, with the usage and the parameters of a node."""
    from lidar_perception.nodes.node_parameters import find_node_parameters
    from lidar_perception.param_fields import describe_fields

    lines = [f"Usage: {name} --ros-args [-p PARAMETER:=VALUE] [-r FROM:=TO] [--params-file YAML]", "", "Parameters:"]
    return "\n".join([*lines, *describe_fields(find_node_parameters(name))])


def run(name: str, arguments: list[str]) -> int:
    """Run nodes until they are done or a signal (SIGINT or SIGTERM) arrives; return the exit code.

    The exit code is 0 after a signal, and 2 if a node cannot start.

    Args:
        name: executable of the first node.
        arguments: the same name, followed by its ROS arguments. Further nodes for the same process
            may follow, each after `---`. Arguments for the whole process, such as
            `--ros-args --log-level debug`, come last, after another `---`.
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
            print(make_help_text(name), flush=True)
        except BrokenPipeError:  # output piped to `head`: keep Python from flushing again at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    nodes, process_arguments = split_arguments(arguments)
    from lidar_perception.nodes.shared_memory import reads_driver_clouds, use_large_shared_memory

    use_large_shared_memory(any(map(reads_driver_clouds, nodes)))
    from lidar_perception.types import InputError

    try:
        require_rclpy()
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    from rclpy.logging import get_logger

    from lidar_perception.runs.compiling import report_compilation

    with report_compilation(get_logger(_find_logger_name(nodes[0])).info):
        classes = [load_node_class(node[0]) for node in nodes]
    if len(nodes) == 1 and not process_arguments:
        return _run_nodes([(classes[0], nodes[0], {})], nodes[0], begin, stop)
    from lidar_perception.nodes.links import Links

    links = Links()
    node_specs = [(cls, node, {"cli_args": node[1:], "links": links}) for cls, node in zip(classes, nodes)]
    return _run_nodes(node_specs, process_arguments, begin, stop)


def split_arguments(arguments: list[str]) -> tuple[list[list[str]], list[str]]:
    """Return the arguments of each node, and the arguments of the process."""
    from lidar_perception.nodes.graph import SEPARATOR

    parts: list[list[str]] = [[]]
    for word in arguments:
        if word == SEPARATOR:
            parts.append([])
        else:
            parts[-1].append(word)
    nodes = [part for part in parts if part and part[0] in NODES]
    return nodes, [word for part in parts if part not in nodes for word in part]


def _find_logger_name(arguments: list[str]) -> str:
    """Return the logger name that a node with these arguments will have.

    It is the remapped name of the node, or the name of the executable, with the namespace.
    """
    rules = [
        rule.rpartition(":__")[2].removeprefix("__").partition(":=")
        for option, rule in pairwise(arguments)
        if option in ("-r", "--remap")
    ]
    names = {key: value for key, _, value in rules if re.fullmatch(r"[A-Za-z_/][\w/]*", value)}
    name = names.get("node") or names.get("name") or arguments[0]
    return ".".join([*filter(None, names.get("ns", "").split("/")), name])


def _find_misspelt_sections(arguments: list[str], node: str) -> list[str]:
    """Return a warning for each section of the parameter files with almost the name of this node."""
    from lidar_perception.nodes.param_files import describe_unknown_nodes
    from lidar_perception.types import InputError

    lines = []
    for path in [value for option, value in pairwise(arguments) if option == "--params-file"]:
        with suppress(InputError):  # for example a file that is too large for us; rcl has already read it
            lines += describe_unknown_nodes(path, [node], only_similar=True)
    return lines


def _exit_process(nodes: list[LidarNode]) -> None:
    """End the process immediately, even during work such as a compilation."""
    import rclpy
    from rclpy.logging import LoggingSeverity

    with suppress(Exception):
        for node in nodes:
            node.get_logger().set_level(LoggingSeverity.FATAL)  # work that still runs will log errors
            node.destroy_node()
        rclpy.try_shutdown()
    os._exit(0)


def _run_nodes(
    node_specs: list[tuple[type, list[str], dict[str, Any]]], process_arguments: list[str], begin: float, stop: Stop
) -> int:
    """Create nodes, spin each in its own thread, and return the exit code.

    Args:
        node_specs: (class, arguments, options of the class) of each node.
        process_arguments: ROS arguments of the process.
        begin: perf_counter() at the start of the process.
        stop: signal handler of the process.
    """
    import rclpy
    from rclpy.exceptions import NameValidationException, ParameterException
    from rclpy.logging import get_logger
    from rclpy.signals import SignalHandlerOptions

    from lidar_perception.nodes.rclpy_compat import RCLError, UnknownROSArgsError
    from lidar_perception.runs.files import convert_os_errors
    from lidar_perception.types import InputError

    log = get_logger(_find_logger_name(node_specs[0][1]))
    nodes: list[LidarNode] = []
    code = 1
    start_error: BaseException | None = None  # its traceback keeps the entities of a node alive until shutdown

    def stop_nodes() -> None:
        for node in nodes:
            node.stop.set_result(None)

    try:
        stop.on_signal = lambda: None  # DDS is starting and must be shut down after a signal, see stop.requested
        rclpy.init(args=process_arguments, signal_handler_options=SignalHandlerOptions.NO)
        for node_class, arguments, options in node_specs:
            log = get_logger(_find_logger_name(arguments))
            with convert_os_errors():
                nodes.append(node_class(**options))
        stop.on_signal = stop_nodes
        if not any(node.writes_files for node in nodes):
            stop.force_exit = lambda: _exit_process(nodes)
        if stop.requested:
            stop_nodes()
        if len(nodes) == 1:
            _spin_node(nodes[0], node_specs[0][1], begin)
        else:
            with ThreadPoolExecutor(len(nodes)) as pool:
                futures = [
                    pool.submit(_spin_node, node, arguments, begin)
                    for node, (_, arguments, _) in zip(nodes, node_specs)
                ]
                if any(future.exception() for future in wait(futures, None, FIRST_EXCEPTION).done):
                    stop_nodes()
            for node, future in zip(nodes, futures):
                log = node.get_logger()
                future.result()
        code = 0
    except UnknownROSArgsError as error:
        log.fatal(f"unknown argument after --ros-args: {error}")
        start_error, code = error, 2
    except (InputError, ValueError, ParameterException, NameValidationException, RCLError) as error:
        log.fatal(" ".join(str(error).split()))
        start_error, code = error, 2
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
        del start_error  # DDS shuts down; the guard ends the process if it hangs
        rclpy.try_shutdown()
    return code


def _spin_node(node: LidarNode, arguments: list[str], begin: float) -> None:
    """Start a node and spin it until it should stop."""
    from rclpy.executors import SingleThreadedExecutor

    from lidar_perception.nodes.node_parameters import describe_misspelt_parameters
    from lidar_perception.nodes.rclpy_compat import get_parameter_overrides

    undeclared = [name for name in get_parameter_overrides(node) if not node.has_parameter(name)]
    for line in [*describe_misspelt_parameters(undeclared), *_find_misspelt_sections(arguments, node.get_name())]:
        node.get_logger().warning(line)  # before the node starts, which may take long
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
