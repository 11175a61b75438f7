"""Architecture: allowed imports between modules, docstrings and types."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache

import pytest
from samples import for_all
from sources import ROOT, SOURCES, list_files, parse_source

pytestmark = pytest.mark.no_cover
ROS = {
    "rclpy",
    "ament_index_python",
    "launch",
    "launch_ros",
    "launch_testing",
    "sensor_msgs",
    "std_msgs",
    "geometry_msgs",
    "visualization_msgs",
    "vision_msgs",
    "builtin_interfaces",
    "rosbag2_py",
}

# Packages and modules from the lowest layer up; each imports only itself and lower layers.
LAYERS = (
    "classes",
    "intensity",
    "types",
    "param_fields",
    "geometry",
    "camera",
    "groups",
    "robot",
    "runs",
    "wire",
    "ground",
    "data",
    "clustering",
    "candidates",
    "detectors",
    "tracking",
    "rendering",
    "scoring",
    "simulation",
    "sensor_setup",
    "training",
    "labels",
    "detecting",
    "params",
    "api",
    "nodes",
    "cli",
    "testing",
)
# Libraries that each layer may import besides lower layers and the standard library.
NUMERIC = ["numpy", "scipy", "numba"]
LIBRARIES = {
    "classes": [],
    "intensity": ["numpy"],
    "types": ["numpy"],
    "param_fields": [],
    "geometry": ["numpy", "numba"],
    "camera": NUMERIC,
    "groups": ["numpy"],
    "robot": ["numpy", "scipy"],
    "runs": ["rich", "threadpoolctl", "numba"],
    "wire": ["numpy", "scipy", "rosbags", "msg_utils", "lz4", "zstandard"],
    "data": ["numpy", "scipy", "yaml", "mcap", "rosbags", "msg_utils", "lz4", "zstandard"],
    "ground": NUMERIC,
    "clustering": NUMERIC,
    "candidates": NUMERIC,
    "detectors": [*NUMERIC, "llvmlite", "torch", "safetensors", "onnx", "onnxruntime", "onnxscript"],
    "tracking": [*NUMERIC, "kiss_icp"],
    "rendering": ["numpy", "PIL", "matplotlib", "av", "msg_utils"],
    "sensor_setup": ["numpy", "scipy", "msg_utils"],
    "labels": ["numpy", "msg_utils"],
    "params": [],
}


@cache
def find_imports(name, everywhere=True):
    """Return the modules that a source imports; a.b for `from a import b`.

    everywhere: include imports in functions and under `if TYPE_CHECKING`.
    """
    nodes = ast.walk(parse_source(name)) if everywhere else _run_on_import(parse_source(name))
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


def is_in(module, allowed):
    return any(module == name or module.startswith(name + ".") for name in allowed)


def is_standard(module):
    return module.partition(".")[0] in sys.stdlib_module_names


def find_foreign_imports(name, allowed, everywhere=True):
    return sorted(m for m in find_imports(name, everywhere) if not is_standard(m) and not is_in(m, allowed))


def public_functions(tree):
    return [
        node
        for node in tree.body
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_")
    ]


def test_every_module_belongs_to_a_layer():
    assert len(list_files("msg_utils")) >= 5
    assert {n.split("/")[1].removesuffix(".py") for n in SOURCES if n.startswith("lidar_perception/")} == {
        *LAYERS,
        "__init__",
    }
    for folder in LAYERS[7 : LAYERS.index("params")]:
        assert len(list_files(f"lidar_perception/{folder}")) >= 2


@for_all(list_files("msg_utils"))
def test_msg_utils_needs_only_numpy(name):
    # messages.py imports ROS message classes by name; those of rosbags work as well.
    assert find_foreign_imports(name, ["numpy", "msg_utils"]) == []


def test_only_msg_utils_messages_imports_by_name():
    by_name = [name for name in list_files("msg_utils") if any(m.startswith("importlib") for m in find_imports(name))]
    assert by_name == ["msg_utils/messages.py"]


CORE = [
    name
    for name in SOURCES
    if not name.startswith(
        (*(f"lidar_perception/{layer}/" for layer in LAYERS[-3:]), "lidar_studio/cli/", "lidar_studio/live_view.py")
    )
]


@for_all(CORE)
def test_core_imports_neither_ros_nor_nodes_nor_cli(name):
    ros = {m for m in find_imports(name) if m.partition(".")[0] in ROS}
    assert ros == set()
    above = [m for m in find_imports(name) if is_in(m, ["lidar_perception.nodes", "lidar_perception.cli"])]
    assert above == []


@for_all(list_files("lidar_perception", "msg_utils"))
def test_library_never_imports_the_studio(name):
    assert [m for m in find_imports(name) if is_in(m, ["lidar_studio"])] == []


@for_all(SOURCES)
def test_wheel_never_imports_repository_folders(name):
    assert [m for m in find_imports(name) if is_in(m, ["experiments", "benchmark", "scripts", "test"])] == []


@for_all([name for name in SOURCES if not name.startswith("lidar_perception/nodes/")])
def test_only_nodes_import_rclpy(name):
    assert [m for m in find_imports(name) if is_in(m, ["rclpy"])] == []


@for_all(list_files("lidar_perception/cli"))
def test_importing_the_cli_does_not_import_ros(name):
    ros = {m for m in find_imports(name, everywhere=False) if m.partition(".")[0] in ROS}
    assert ros == set()


def get_layer(name):
    """Return the layer of a module or file by its name."""
    return name.replace("/", ".").split(".")[1] if "." in name.replace("/", ".") else ""


@for_all([n for n in SOURCES if n.startswith("lidar_perception/") and n != "lidar_perception/__init__.py"])
def test_layers_import_only_lower_layers(name):
    below = LAYERS[: LAYERS.index(get_layer(name.removesuffix(".py"))) + 1]
    above = [
        m
        for m in find_imports(name)
        if m.startswith("lidar_perception.") and m != "lidar_perception.__version__" and get_layer(m) not in below
    ]
    assert above == []


@for_all([n for n in list_files("lidar_studio") if n in CORE])
def test_studio_imports_only_allowed_libraries(name):
    assert find_foreign_imports(name, ["numpy", "aiohttp", "msg_utils", "lidar_perception", "lidar_studio"]) == []


@for_all([n for n in list_files("lidar_perception") if get_layer(n.removesuffix(".py")) in LIBRARIES])
def test_layers_import_only_allowed_libraries(name):
    allowed = [*LIBRARIES[get_layer(name.removesuffix(".py"))], "lidar_perception"]
    assert find_foreign_imports(name, allowed) == []


NETWORKS = "lidar_perception.detectors.pointpillars", "lidar_perception.detectors.pointnet"


@for_all(list_files(*(n.replace(".", "/") for n in NETWORKS)))
def test_networks_do_not_import_each_other(name):
    (other,) = (n for n in NETWORKS if not name.startswith(n.replace(".", "/")))
    assert [m for m in find_imports(name) if is_in(m, [other])] == []


SHARED_TRAINING = [
    f"lidar_perception/training/{name}.py"
    for name in (
        "schedule",
        "distributed",
        "log",
        "run",
        "run_directory",
        "loop",
        "plan",
        "planning",
        "start",
        "trainer",
        "augment",
        "pasting",
        "database",
        "data",
    )
]


@for_all(SHARED_TRAINING)
def test_shared_training_imports_no_network(name):
    assert [m for m in find_imports(name) if is_in(m, NETWORKS)] == []


def test_modules_have_no_circular_imports():
    modules = {name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): name for name in SOURCES}
    packages = {
        name.removesuffix("/__init__.py").replace("/", ".") for name in SOURCES if name.endswith("/__init__.py")
    }
    imported_by_module = {
        m: {
            other
            for i in find_imports(name)
            for other in (i, i.rpartition(".")[0])
            if other in modules and other not in packages and other != m
        }
        for m, name in modules.items()
    }
    done, path = set(), []

    def visit(module):
        assert module not in path, " -> ".join([*path[path.index(module) :], module])
        if module not in done:
            path.append(module)
            for other in imported_by_module[module]:
                visit(other)
            done.add(path.pop())

    for module in modules:
        visit(module)


@for_all(CORE)
def test_every_public_function_has_a_docstring(name):
    without = [
        node.name
        for node in public_functions(parse_source(name))
        if isinstance(node, ast.FunctionDef) and not ast.get_docstring(node)
    ]
    assert without == []


STRICT = tuple(
    f"lidar_perception/{layer}"
    for layer in LAYERS[: LAYERS.index("data")] + ("clustering", "candidates", "tracking", "sensor_setup", "labels")
    if layer != "runs"
) + ("lidar_studio", "msg_utils")


@for_all([n for n in SOURCES if n.startswith(STRICT)])
def test_core_functions_without_numba_have_types(name):
    """mypy would also require types in functions for Numba, which ignores them (setup.cfg)."""

    def has_types(node):
        arguments = [
            *node.args.posonlyargs,
            *node.args.args,
            *node.args.kwonlyargs,
            *filter(None, (node.args.vararg, node.args.kwarg)),
        ]
        return (node.returns or node.name == "__init__") and all(
            a.annotation or a.arg in ("self", "cls") for a in arguments
        )

    assert [
        node.name
        for node in ast.walk(parse_source(name))
        if isinstance(node, ast.FunctionDef)
        and not any("njit" in ast.unparse(d) for d in node.decorator_list)
        and not has_types(node)
    ] == []


# Modules, and libraries that they must not load. Starting Python takes a second, so one interpreter imports all
# modules of a list in order. A module must therefore not load libraries that a later one excludes.
LIGHT = (
    [
        ("msg_utils.point_cloud2", "numba torch matplotlib scipy rosbags lidar_perception"),
        ("msg_utils.markers", "numba torch matplotlib scipy rosbags lidar_perception"),
        ("lidar_perception.types", "numba torch matplotlib scipy sklearn rosbags rich click"),
        ("lidar_perception.params", "numba torch matplotlib scipy sklearn rosbags rich click"),
        ("lidar_perception.wire.topics", "numba torch matplotlib scipy sklearn rosbags rich click"),
        ("lidar_perception.detectors.pointpillars.config", "numba torch matplotlib scipy sklearn rich click"),
        ("lidar_perception.detectors.pointnet.config", "numba torch matplotlib scipy sklearn rich click"),
        ("lidar_perception.detectors.pointnet.params", "numba torch matplotlib scipy sklearn rich click"),
        ("lidar_perception.training.params", "numba torch matplotlib scipy rich click"),
        ("lidar_perception.detectors.pointpillars.params", "numba torch matplotlib scipy click"),
        ("lidar_perception.detectors.weights_file", "numba torch matplotlib scipy click"),
        ("lidar_perception.geometry", "torch matplotlib sklearn rosbags rich click"),
        ("lidar_perception.candidates.pipeline", "torch matplotlib sklearn rosbags rich click"),
        ("lidar_perception.detectors.pointpillars.expert", "torch matplotlib sklearn rosbags rich click"),
        ("lidar_perception.scoring.nuscenes.report", "torch matplotlib sklearn click rosbags"),
        ("lidar_perception.scoring.centres.report", "torch matplotlib sklearn click"),
        ("lidar_perception.scoring.kitti.report", "torch matplotlib sklearn click"),
        ("experiments.comparison.outcomes", "torch matplotlib sklearn click"),
        ("experiments.stm_cpa.experiment", "torch matplotlib sklearn click jinja2 distributed"),
        ("lidar_perception.camera", "torch matplotlib sklearn"),
        ("lidar_perception.api", "torch matplotlib"),
    ],
    [
        ("lidar_perception", "numpy numba torch matplotlib scipy rosbags rich click"),
        ("lidar_perception.testing", "numpy numba torch matplotlib scipy rosbags click launch_testing"),
        ("lidar_perception.cli.main", "numba torch matplotlib scipy sklearn rosbags"),
        ("experiments.comparison.command", "numba torch matplotlib scipy sklearn"),
        ("experiments.framework.command", "numba torch matplotlib scipy sklearn jinja2 distributed"),
        ("lidar_perception.cli.train", "numba torch matplotlib scipy"),
        ("lidar_perception.cli.weights", "numba torch matplotlib scipy"),
    ],
    [
        ("lidar_perception.detectors.pointpillars.detector", "onnx onnxruntime matplotlib sklearn rich click"),
        ("lidar_perception.detectors.pointnet.detector", "onnx onnxruntime matplotlib sklearn rich click"),
    ],
)
IMPORT_SCRIPT = """
import importlib, sys
for case in sys.argv[1:]:
    module, *heavy = case.split()
    importlib.import_module(module)
    if found := sys.modules.keys() & {*heavy, "rclpy"}:
        print(module, "loads", *found)
"""


@pytest.mark.parametrize("cases", LIGHT, ids=["core", "commands", "networks"])
def test_modules_do_not_import_unneeded_libraries(cases):
    result = subprocess.run(
        [sys.executable, "-c", IMPORT_SCRIPT, *map(" ".join, cases)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert result.stdout == ""
