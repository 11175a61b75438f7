"""Stand-in for the parts of launch and launch_ros (Jazzy) that the package's launch files use. install() replaces
launch and launch_ros by it. Launch executes a launch file as
`ros2 launch` does, and run() starts its nodes. Respawning and RViz are left out.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from types import ModuleType, SimpleNamespace
from typing import Any

import yaml

STOP_TIMEOUT_S = 60.0
LAUNCH_FILES = Path(__file__).resolve().parents[2] / "launch"


class LaunchConfiguration:
    def __init__(self, name: str):
        self.name = name


class LaunchDescription:
    def __init__(self, entities=()):
        self.entities = [*entities]


class DeclareLaunchArgument:
    def __init__(self, name, *, default_value=None, description="", choices=None):
        self.name, self.default_value, self.choices = name, default_value, choices

    def execute(self, context):
        value = context.launch_configurations.setdefault(self.name, self.default_value)
        if value is None:
            raise RuntimeError(f"the launch argument '{self.name}' is required")
        if self.choices and value not in self.choices:
            raise RuntimeError(f"{self.name}:={value} must be one of {self.choices}")


class PythonLaunchDescriptionSource:
    def __init__(self, path: str):
        self.path = path


class IncludeLaunchDescription:
    def __init__(self, source, launch_arguments=()):
        self.source, self.launch_arguments = source, (*launch_arguments,)

    def execute(self, context):
        spec = importlib.util.spec_from_file_location("launch_file", self.source.path)
        file = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(file)
        description = file.generate_launch_description()
        for name, value in self.launch_arguments:
            context.launch_configurations[name] = context.perform_substitution(value)
        return description.entities


class OpaqueFunction:
    def __init__(self, function):
        self.function = function

    def execute(self, context):
        return self.function(context)


class LogInfo:
    def __init__(self, msg):
        self.msg = msg

    def execute(self, context):
        context.messages.append(self.msg)


class OnProcessExit:
    def __init__(self, target_action, on_exit):
        self.target_action, self.on_exit = target_action, on_exit


class RegisterEventHandler:
    def __init__(self, handler):
        self.handler = handler

    def execute(self, context):
        context.handlers.append(self.handler)


class TimerAction:
    def __init__(self, period, actions):
        self.period, self.actions = period, actions

    def execute(self, context):
        context.timers.append((monotonic() + self.period, self.actions))


class Shutdown:
    def __init__(self, reason):
        self.reason = reason


class EmitEvent:
    def __init__(self, event):
        self.event = event

    def execute(self, context):
        context.shutdown_reason = self.event.reason


class Node(SimpleNamespace):
    def __init__(
        self,
        *,
        executable,
        package,
        name=None,
        namespace=None,
        parameters=(),
        remappings=(),
        arguments=(),
        ros_arguments=(),
        output="log",
        respawn=False,
        respawn_delay=0.0,
        exec_name=None,
    ):
        super().__init__(**{k: v for k, v in locals().items() if k not in ("self", "__class__")})

    def execute(self, context):
        context.nodes.append(self)

    def list_arguments(self, folder: Path) -> list[str]:
        """Return the command line; parameter values are written to a file in `folder`."""
        rules = [
            *([("__node", self.name)] if self.name else []),
            *([("__ns", f"/{self.namespace}")] if self.namespace else []),
            *self.remappings,
        ]
        words = [self.executable, *self.arguments, "--ros-args", *self.ros_arguments]
        words += [word for a, b in rules for word in ("-r", f"{a}:={b}")]
        for number, parameters in enumerate(self.parameters):
            if isinstance(parameters, Mapping):
                file = folder / f"{self.namespace}-{self.name}-{number}.yaml"
                file.write_text(yaml.safe_dump({"/**": {"ros__parameters": dict(parameters)}}))
                parameters = str(file)
            words += ["--params-file", parameters]
        return words


MODULES: dict[str, tuple] = {
    "launch": (LaunchDescription,),
    "launch.actions": (
        DeclareLaunchArgument,
        EmitEvent,
        IncludeLaunchDescription,
        LogInfo,
        OpaqueFunction,
        RegisterEventHandler,
        TimerAction,
    ),
    "launch.event_handlers": (OnProcessExit,),
    "launch.events": (Shutdown,),
    "launch.launch_description_sources": (PythonLaunchDescriptionSource,),
    "launch.substitutions": (LaunchConfiguration,),
    "launch_ros": (),
    "launch_ros.actions": (Node,),
}


def install(monkeypatch) -> None:
    """Replace launch and launch_ros until the end of a test."""
    for name, classes in MODULES.items():
        module = ModuleType(name)
        vars(module).update({kind.__name__: kind for kind in classes})
        monkeypatch.setitem(sys.modules, name, module)
    shared = "lidar_perception.nodes.launching"
    monkeypatch.setitem(sys.modules, shared, None)  # discards the version of an earlier test
    del sys.modules[shared]


class Launch:
    """The execution of a launch file of this package.

    Attributes:
        nodes: the nodes to start.
        messages: the lines to log.
        launch_configurations: the arguments, of all files.
        shutdown_reason: of the event that ended run(), or None.
    """

    def __init__(self, name: str, arguments: Mapping[str, str]):
        self.launch_configurations: dict[str, Any] = {}
        self.nodes: list[Node] = []
        self.messages: list[str] = []
        self.handlers: list[OnProcessExit] = []
        self.timers: list[tuple[float, list]] = []
        self.shutdown_reason: str | None = None
        self._execute(
            IncludeLaunchDescription(
                PythonLaunchDescriptionSource(str(LAUNCH_FILES / f"{name}.launch.py")), arguments.items()
            )
        )

    def perform_substitution(self, value: Any) -> str:
        if isinstance(value, LaunchConfiguration):
            return self.launch_configurations[value.name]
        return value if isinstance(value, str) else "".join(map(self.perform_substitution, value))

    def _execute(self, action: Any) -> None:
        for further in action.execute(self) or ():
            self._execute(further)

    def start(self, processes: Any) -> None:
        """Start the nodes; `processes` is the fixture of this name."""
        self.process_names = {}
        for node in self.nodes:
            name = "-".join(filter(None, (node.namespace, node.name or node.exec_name)))
            self.process_names[name] = node
            processes.run_node(name, node.list_arguments(processes.logs))

    def run(self, processes: Any, wait: Callable[[Callable[[], Any], str], None]) -> None:
        """Handle events of started nodes until one of them is a shutdown; then end the nodes."""
        waiting = dict(self.process_names)

        def is_shut_down() -> bool:
            for name in [name for name in waiting if processes.has_ended(name)]:
                node = waiting.pop(name)
                for handler in self.handlers:
                    if handler.target_action is node:
                        for action in handler.on_exit:
                            self._execute(action)
            due = [actions for at, actions in self.timers if at <= monotonic()]
            self.timers = [timer for timer in self.timers if timer[0] > monotonic()]
            for action in [action for actions in due for action in actions]:
                self._execute(action)
            return self.shutdown_reason is not None

        wait(is_shut_down, "the shutdown of the launch file")
        processes.stop(STOP_TIMEOUT_S)
