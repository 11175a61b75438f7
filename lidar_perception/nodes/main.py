"""Starts a node: signals first, then compiled code, then ROS. Every executable enters here."""

from __future__ import annotations

import fcntl
import importlib
import os
import signal
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

from lidar_perception.nodes import NODES, require_rclpy
from lidar_perception.runs.threads import one_thread_each

if TYPE_CHECKING:
    from lidar_perception.nodes.stopping import Stop


def node_parameters(name: str) -> dict[str, Any]:
    """Name of each parameter of a node -> its dataclass field, with the node's default."""
    from lidar_perception.param_fields import parameter_fields
    found: dict[str, Any] = {}
    for path in NODES[name][1:]:
        module, _, params = path.rpartition(".")
        made = getattr(importlib.import_module(f"lidar_perception.{module}"), params)()
        found |= parameter_fields(made)
    return found


def help_text(name: str) -> str:
    """What --help prints: how to start the node, and its parameters."""
    lines = [f"Usage: {name} --ros-args [-p PARAMETER:=VALUE] [-r FROM:=TO] [--params-file YAML]",
             "", "Parameters:"]
    for key, f in node_parameters(name).items():
        default = list(f.default) if isinstance(f.default, tuple) else f.default
        unit = f" {f.metadata['unit']}" if f.metadata["unit"] else ""
        lines += [f"  {key} (default {default!r}{unit})", f"      {f.metadata['doc']}"]
    return "\n".join(lines)


STOP_SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM})
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROFILES = {256 * 2**20: "fastdds.xml", 40 * 2**20: "fastdds_small.xml"}  # free bytes needed
DRIVER_PROFILE, SOCKET_BUFFER = "fastdds_driver.xml", 2 * 2**20  # bytes of net.core.rmem_max needed


def use_large_shared_memory(from_driver: bool = False) -> None:
    """Let Fast DDS pass whole clouds through shared memory, see fastdds.xml; less of it where
    /dev/shm is small, as the 64 MB of a container are. With from_driver, clouds come by UDP where
    the socket's buffer can hold one, see fastdds_driver.xml. A profile of the user's own stays."""
    if any(os.environ.get(name) for name in PROFILE_VARIABLES):
        return
    try:
        memory = os.statvfs("/dev/shm")
    except OSError:
        return
    free = memory.f_bavail * memory.f_frsize
    profile = next((name for needed, name in PROFILES.items() if free >= needed), None)
    if profile != "fastdds.xml":
        print(f"/dev/shm has only {free / 2**20:.0f} MB free, so clouds above "
              f"{3 if profile else 0} MB may get lost between processes; start the container with "
              "--shm-size=1g", file=sys.stderr)
    if from_driver and profile == "fastdds.xml" and socket_buffer() >= SOCKET_BUFFER:
        profile = DRIVER_PROFILE
    if profile:
        for name in PROFILE_VARIABLES:
            os.environ[name] = str(Path(__file__).with_name(profile))


def socket_buffer() -> int:
    """net.core.rmem_max, bytes that a socket may hold; 0 where it is not known."""
    try:
        return int(Path("/proc/sys/net/core/rmem_max").read_text())
    except (OSError, ValueError):
        return 0


def fed_by_a_driver(arguments: list[str]) -> bool:
    """Whether a node's clouds come from outside: those of our nodes are NODE/output/points."""
    return not any(word.endswith("/output/points") for word in arguments)


@contextmanager
def one_at_a_time():
    """The first node compiles, the others wait and load what it has cached: when all compile the
    same at once on few cores, each takes as many times longer."""
    with open(Path(tempfile.gettempdir()) / f"lidar_perception-{os.getuid()}.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


def run(name: str, arguments: list[str]) -> int:
    """Run a node until SIGINT or SIGTERM (exit code 0), or until it is done. 2: it cannot start."""
    if {"-h", "--help"} & set(arguments[1:]):
        print(help_text(name))
        return 0
    begin = perf_counter()
    # Threads inherit the mask, so this comes before any library starts one; what arrives from now
    # on waits for Stop.
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    one_thread_each()  # or nodes that share few cores stand in each other's way
    use_large_shared_memory(fed_by_a_driver(arguments))
    from lidar_perception.nodes.stopping import Stop
    stop = Stop(STOP_SIGNALS)
    from lidar_perception.types import InputError
    try:
        require_rclpy()
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    module = importlib.import_module(f"lidar_perception.nodes.{name}")
    if hasattr(module, "warm_up"):
        with one_at_a_time():
            module.warm_up()
    return _spin(getattr(module, NODES[name][0]), arguments, perf_counter() - begin, stop)


def _spin(node_class: type, arguments: list[str], seconds: float, stop: Stop) -> int:
    import rclpy
    from rclpy.exceptions import ParameterException
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from lidar_perception.types import InputError

    rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    node, code = None, 0
    try:
        node = node_class()
        node.start()
        stop.react = lambda: node.stop.set_result(None)
        node.get_logger().info(f"ready: code loaded and warmed up in {seconds:.1f} s")
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        node.spin(executor)
    except (InputError, ValueError, ParameterException) as error:
        rclpy.logging.get_logger(node_class.__name__).fatal(str(error))
        code = 2
    finally:
        stop.closing()
        if node is not None:
            node.close()
        stop.closed(code)
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return code


if __name__ == "__main__":
    sys.exit(run(sys.argv[1], sys.argv[1:]))
