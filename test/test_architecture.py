"""The shape of the house: which module may import which, and how every room looks."""

from __future__ import annotations

import ast
import subprocess
import sys
from configparser import ConfigParser
from functools import cache
from pathlib import Path

import pytest
from samples import for_all

pytestmark = pytest.mark.no_cover  # it reads sources
ROOT = Path(__file__).resolve().parents[1]
PACKAGES = "lidar_perception", "lidar_studio", "msg_utils"
SOURCES = [p.relative_to(ROOT).as_posix() for package in PACKAGES
           for p in sorted((ROOT / package).rglob("*.py"))]
ROS = {"rclpy", "ament_index_python", "launch", "launch_ros", "launch_testing", "sensor_msgs",
       "std_msgs", "geometry_msgs", "visualization_msgs", "vision_msgs", "builtin_interfaces",
       "rosbag2_py"}
MAX_LINES = 400

# From the ground up: a room imports only those before it, and itself.
ROOMS = ("classes", "intensity", "types", "param_fields", "geometry", "camera", "groups", "robot",
         "runs", "wire", "ground", "data", "clustering", "candidates", "detectors", "tracking",
         "rendering", "scoring", "simulation", "sensor_setup", "training", "labels",
         "detecting", "params", "api", "nodes", "cli", "testing")
# What the files of a room may import besides the rooms below and the standard library.
NUMBERS = ["numpy", "scipy", "numba"]
STRANGERS = {
    "classes": [], "intensity": ["numpy"], "types": ["numpy"], "param_fields": [],
    "geometry": ["numpy", "numba"], "camera": NUMBERS,
    "groups": ["numpy"], "robot": ["numpy", "scipy"],
    "runs": ["rich", "threadpoolctl", "numba"],
    "wire": ["numpy", "scipy", "rosbags", "msg_utils", "lz4", "zstandard"],
    "data": ["numpy", "scipy", "yaml", "mcap", "rosbags", "msg_utils", "lz4", "zstandard"],
    "ground": NUMBERS, "clustering": NUMBERS, "candidates": NUMBERS,
    "detectors": [*NUMBERS, "llvmlite", "torch", "safetensors", "onnx", "onnxruntime",
                  "onnxscript"],
    "tracking": [*NUMBERS, "kiss_icp"],
    "rendering": ["numpy", "PIL", "matplotlib", "av", "msg_utils"],
    "sensor_setup": ["numpy", "scipy", "msg_utils"],
    "labels": ["numpy", "msg_utils"], "params": [],
}


@cache  # parsed by the first test: every process that collects the tests imports this file
def tree_of(name):
    return ast.parse((ROOT / name).read_text(encoding="utf-8"), name)


@cache
def imports(name, everywhere=True):
    """Modules that a source imports; `from a import b` counts as a.b. Those inside functions and
    `if TYPE_CHECKING` only with everywhere."""
    nodes = ast.walk(tree_of(name)) if everywhere else _run_on_import(tree_of(name))
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def _run_on_import(tree):
    waiting = list(tree.body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
            continue
        yield node
        waiting += ast.iter_child_nodes(node)


def within(module, allowed):
    return any(module == name or module.startswith(name + ".") for name in allowed)


def standard(module):
    return module.partition(".")[0] in sys.stdlib_module_names


def files_in(*folders):
    return [name for name in SOURCES if any(name.startswith(f"{folder}/") for folder in folders)]


def strangers(name, allowed, everywhere=True):
    return sorted(m for m in imports(name, everywhere)
                  if not standard(m) and not within(m, allowed))


def public_functions(tree):
    return [node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))
            and not node.name.startswith("_")]


def test_there_are_sources_to_look_at():
    assert len(files_in("msg_utils")) >= 5
    assert {n.split("/")[1].removesuffix(".py") for n in SOURCES
            if n.startswith("lidar_perception/")} == {*ROOMS, "__init__"}
    for folder in ROOMS[7:ROOMS.index("params")]:
        assert len(files_in(f"lidar_perception/{folder}")) >= 2


@for_all(files_in("msg_utils"))
def test_msg_utils_needs_numpy_and_itself_only(name):
    # ROS's message classes come in by name (messages.py), so that rosbags' own do as well.
    assert strangers(name, ["numpy", "msg_utils"]) == []


def test_only_messages_of_msg_utils_imports_by_name():
    by_name = [name for name in files_in("msg_utils")
               if any(m.startswith("importlib") for m in imports(name))]
    assert by_name == ["msg_utils/messages.py"]


OUTSIDE = [name for name in SOURCES
           if not name.startswith((*(f"lidar_perception/{room}/" for room in ROOMS[-3:]),
                                   "lidar_studio/cli/", "lidar_studio/live_view.py"))]


@for_all(OUTSIDE)
def test_the_core_imports_no_ros_no_nodes_and_no_command_line(name):
    ros = {m for m in imports(name) if m.partition(".")[0] in ROS}
    assert ros == set()
    above = [m for m in imports(name)
             if within(m, ["lidar_perception.nodes", "lidar_perception.cli"])]
    assert above == []


@for_all(files_in("lidar_perception", "msg_utils"))
def test_library_never_imports_the_studio(name):
    assert [m for m in imports(name) if within(m, ["lidar_studio"])] == []


@for_all(SOURCES)
def test_wheel_never_imports_repository_folders(name):
    assert [m for m in imports(name)
            if within(m, ["experiments", "benchmark", "scripts", "test"])] == []


@for_all([name for name in SOURCES if not name.startswith("lidar_perception/nodes/")])
def test_rclpy_is_imported_by_nodes_alone(name):
    assert [m for m in imports(name) if within(m, ["rclpy"])] == []


@for_all(files_in("lidar_perception/cli"))
def test_the_command_line_imports_no_ros_when_it_is_imported(name):
    ros = {m for m in imports(name, everywhere=False) if m.partition(".")[0] in ROS}
    assert ros == set()


def room(name):
    """Of a module or a file's name."""
    return name.replace("/", ".").split(".")[1] if "." in name.replace("/", ".") else ""


@for_all([n for n in SOURCES if n.startswith("lidar_perception/")
          and n != "lidar_perception/__init__.py"])
def test_no_arrow_points_up(name):
    """Imports inside functions count, and those for types."""
    below = ROOMS[:ROOMS.index(room(name.removesuffix(".py"))) + 1]
    above = [m for m in imports(name) if m.startswith("lidar_perception.")
             and m != "lidar_perception.__version__" and room(m) not in below]
    assert above == []


@for_all([n for n in files_in("lidar_studio") if n in OUTSIDE])
def test_the_studio_needs_few_other_libraries(name):
    assert strangers(name, ["numpy", "aiohttp", "msg_utils", "lidar_perception",
                            "lidar_studio"]) == []


@for_all([n for n in files_in("lidar_perception") if room(n.removesuffix(".py")) in STRANGERS])
def test_a_room_of_the_core_needs_no_other_library(name):
    allowed = [*STRANGERS[room(name.removesuffix(".py"))], "lidar_perception"]
    assert strangers(name, allowed) == []


NETWORKS = "lidar_perception.detectors.pointpillars", "lidar_perception.detectors.pointnet"


@for_all(files_in(*(n.replace(".", "/") for n in NETWORKS)))
def test_a_network_knows_no_other(name):
    other, = (n for n in NETWORKS if not name.startswith(n.replace(".", "/")))
    assert [m for m in imports(name) if within(m, [other])] == []


SHARED_TRAINING = [f"lidar_perception/training/{name}.py" for name in (
    "schedule", "distributed", "log", "run", "run_directory", "loop", "plan", "planning", "start",
    "trainer", "augment", "pasting", "database", "data")]

@for_all(SHARED_TRAINING)
def test_what_all_networks_train_with_knows_none_of_them(name):
    assert [m for m in imports(name) if within(m, NETWORKS)] == []


def test_modules_do_not_import_in_circles():
    """Imports inside functions count, and those for types."""
    modules = {name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): name
               for name in SOURCES}
    packages = {name.removesuffix("/__init__.py").replace("/", ".") for name in SOURCES
                if name.endswith("/__init__.py")}
    arrows = {m: {other for i in imports(name)
                  for other in (i, i.rpartition(".")[0])
                  if other in modules and other not in packages and other != m}
              for m, name in modules.items()}
    done, path = set(), []

    def visit(module):
        assert module not in path, " -> ".join([*path[path.index(module):], module])
        if module not in done:
            path.append(module)
            for other in arrows[module]:
                visit(other)
            done.add(path.pop())

    for module in modules:
        visit(module)


FORMATS = ("lidar_perception/classes.py", "lidar_perception/data/",  # whose words these are
           "lidar_perception/simulation/shapes/",  # each class has a shape of its own
           "lidar_perception/detectors/pointpillars/import_weights.py")


@for_all([n for n in SOURCES if n.startswith("lidar_perception/")
          and not n.startswith(FORMATS)])
def test_a_class_is_named_in_one_table(name):
    from lidar_perception.classes import CLASSES
    written = {node.value for node in ast.walk(tree_of(name)) if isinstance(node, ast.Constant)
               and isinstance(node.value, str)}
    assert written & set(CLASSES) - {"DontCare", "Misc"} == set()


@for_all(OUTSIDE)
def test_every_public_function_has_a_docstring(name):
    without = [node.name for node in public_functions(tree_of(name))
               if isinstance(node, ast.FunctionDef) and not ast.get_docstring(node)]
    assert without == []


STRICT = tuple(f"lidar_perception/{room}" for room in ROOMS[:ROOMS.index("data")] + (
    "clustering", "candidates", "tracking", "sensor_setup", "labels")
    if room != "runs") + ("lidar_studio", "msg_utils")


@for_all([n for n in SOURCES if n.startswith(STRICT)])
def test_every_function_of_the_core_says_its_types_but_those_that_numba_compiles(name):
    """mypy asks for all or none (setup.cfg); Numba reads none."""
    def typed(node):
        named = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs,
                 *filter(None, (node.args.vararg, node.args.kwarg))]
        return (node.returns or node.name == "__init__") and all(
            a.annotation or a.arg in ("self", "cls") for a in named)
    assert [node.name for node in ast.walk(tree_of(name)) if isinstance(node, ast.FunctionDef)
            and not any("njit" in ast.unparse(d) for d in node.decorator_list)
            and not typed(node)] == []


def test_mypy_ignores_no_module():
    settings = ConfigParser()
    settings.read(ROOT / "setup.cfg")
    asked = {name: dict(settings[name]) for name in settings if name.startswith("mypy")}
    assert asked["mypy"]["files"] == (
        "lidar_perception, lidar_studio, msg_utils, scripts, benchmark, experiments, examples")
    assert {name for name, options in asked.items()
            if {"ignore_errors", "exclude", "follow_imports"} & set(options)} == {"mypy-launch"}
    assert [name for name in SOURCES if "# mypy:" in (ROOT / name).read_text()] == []


@for_all(SOURCES)
def test_every_module_says_what_it_is_for_and_is_no_room_for_odds_and_ends(name):
    assert ast.get_docstring(tree_of(name)), "no docstring"
    parts = Path(name).with_suffix("").parts
    assert not {"utils", "util", "helpers", "common", "misc"} & set(parts)


@for_all(SOURCES)
def test_no_source_is_longer_than_a_reader_can_hold(name):
    assert len((ROOT / name).read_text(encoding="utf-8").splitlines()) <= MAX_LINES


def test_a_number_of_clustering_goes_by_a_name_of_its_own():
    """Its modules take each other's, and a reader must not take one for the other."""
    homes = {}
    for name in files_in("lidar_perception/clustering"):
        for node in tree_of(name).body:
            if isinstance(node, ast.Assign) and isinstance(node.value, (ast.Constant, ast.BinOp)):
                for target in node.targets:
                    homes.setdefault(ast.unparse(target), []).append(name)
    assert len(homes) > 10 and {n: w for n, w in homes.items() if len(w) > 1} == {}


# What modules do without. Those of one list are imported one after the other by one interpreter,
# which a second takes to start; each must do without what the ones after it load.
LIGHT = [
    ("msg_utils.point_cloud2", "numba torch matplotlib scipy rosbags lidar_perception"),
    ("msg_utils.markers", "numba torch matplotlib scipy rosbags lidar_perception"),
    ("lidar_perception.types", "numba torch matplotlib scipy sklearn rosbags rich click"),
    ("lidar_perception.params", "numba torch matplotlib scipy sklearn rosbags rich click"),
    ("lidar_perception.wire.topics", "numba torch matplotlib scipy sklearn rosbags rich click"),
    ("lidar_perception.detectors.pointpillars.config",
     "numba torch matplotlib scipy sklearn rich click"),
    ("lidar_perception.detectors.pointnet.config",
     "numba torch matplotlib scipy sklearn rich click"),
    ("lidar_perception.detectors.pointnet.params",
     "numba torch matplotlib scipy sklearn rich click"),
    ("lidar_perception.training.params", "numba torch matplotlib scipy rich click"),
    ("lidar_perception.detectors.pointpillars.params", "numba torch matplotlib scipy click"),
    ("lidar_perception.detectors.pointpillars.weights_file", "numba torch matplotlib scipy click"),
    ("lidar_perception.detectors.pointnet.weights_file", "numba torch matplotlib scipy click"),
    ("lidar_perception.geometry", "torch matplotlib sklearn rosbags rich click"),
    ("lidar_perception.candidates.pipeline", "torch matplotlib sklearn rosbags rich click"),
    ("lidar_perception.detectors.pointpillars.expert",
     "torch matplotlib sklearn rosbags rich click"),
    ("lidar_perception.scoring.nuscenes.report", "torch matplotlib sklearn click rosbags"),
    ("lidar_perception.scoring.centres.report", "torch matplotlib sklearn click"),
    ("lidar_perception.scoring.kitti.report", "torch matplotlib sklearn click"),
    ("experiments.comparison.outcomes", "torch matplotlib sklearn click"),
    ("experiments.stm_cpa.experiment", "torch matplotlib sklearn click jinja2 distributed"),
    ("lidar_perception.camera", "torch matplotlib sklearn"),
    ("lidar_perception.api", "torch matplotlib"),
], [
    ("lidar_perception", "numpy numba torch matplotlib scipy rosbags rich click"),
    ("lidar_perception.testing", "numpy numba torch matplotlib scipy rosbags click launch_testing"),
    ("lidar_perception.cli.main", "numba torch matplotlib scipy sklearn rosbags"),
    ("experiments.comparison.command", "numba torch matplotlib scipy sklearn"),
    ("experiments.framework.command", "numba torch matplotlib scipy sklearn jinja2 distributed"),
    ("lidar_perception.cli.train", "numba torch matplotlib scipy"),
    ("lidar_perception.cli.weights", "numba torch matplotlib scipy"),
], [
    ("lidar_perception.detectors.pointpillars.detector",
     "onnx onnxruntime matplotlib sklearn rich click"),
    ("lidar_perception.detectors.pointnet.detector",
     "onnx onnxruntime matplotlib sklearn rich click"),
]
IMPORTING = """
import importlib, sys
for case in sys.argv[1:]:
    module, *heavy = case.split()
    importlib.import_module(module)
    if found := sys.modules.keys() & {*heavy, "rclpy"}:
        print(module, "loads", *found)
"""


@pytest.mark.parametrize("cases", LIGHT, ids=["core", "commands", "networks"])
def test_importing_a_module_does_not_load_what_it_does_not_need(cases):
    result = subprocess.run([sys.executable, "-c", IMPORTING, *map(" ".join, cases)], cwd=ROOT,
                            capture_output=True, text=True, check=True)
    assert result.stdout == ""


def test_test_files_import_no_other_test_file():
    """What they share is in test/support or in a conftest.py."""
    for path in sorted((ROOT / "test").rglob("*.py")):
        imported = {name.split(".")[-1] for node in ast.walk(ast.parse(path.read_text()))
                    for name in ([node.module or ""] if isinstance(node, ast.ImportFrom)
                                 else [a.name for a in node.names] if isinstance(node, ast.Import)
                                 else [])}
        assert not [name for name in imported if name.startswith("test_")], path
