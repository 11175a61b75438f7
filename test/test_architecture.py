"""The shape of the house: which module may import which, and how every room looks."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted(p for package in ("lidar_perception", "msg_utils")
                 for p in (ROOT / package).rglob("*.py"))
TREES = {p.relative_to(ROOT).as_posix(): ast.parse(p.read_text(encoding="utf-8"), str(p))
         for p in SOURCES}
ROS = {"rclpy", "ament_index_python", "launch", "launch_ros", "sensor_msgs", "std_msgs",
       "geometry_msgs", "visualization_msgs", "vision_msgs", "builtin_interfaces", "rosbag2_py"}
MAX_LINES = 400

# Each list is what the files of a folder may import; a dotted name includes all inside it.
SHARED = [f"lidar_perception.{name}"
          for name in ("types", "geometry", "params", "files", "rotated_iou")]
ALGORITHMS = [f"lidar_perception.{name}" for name in ("ground", "clustering", "candidates")]
NUMERIC = ["numpy", "scipy", "numba", "sklearn", "pypatchworkpp"]


def imports(tree, everywhere=True):
    """Modules that a source imports; `from a import b` counts as a.b. Those inside functions and
    `if TYPE_CHECKING` only with everywhere."""
    nodes = ast.walk(tree) if everywhere else _run_on_import(tree)
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
    return [name for name in TREES if any(name.startswith(f"{folder}/") for folder in folders)]


def strangers(name, allowed, everywhere=True):
    return sorted(m for m in imports(TREES[name], everywhere)
                  if not standard(m) and not within(m, allowed))


def public_functions(tree):
    return [node for node in tree.body if isinstance(node, (ast.FunctionDef, ast.ClassDef))
            and not node.name.startswith("_")]


def test_there_are_sources_to_look_at():
    assert len(files_in("msg_utils")) >= 5
    for folder in ("ground", "clustering", "candidates", "detection", "pointnet", "hybrid",
                   "training", "nodes", "cli", "datasets", "evaluation", "reproduction"):
        assert len(files_in(f"lidar_perception/{folder}")) >= 2


@pytest.mark.parametrize("name", files_in("msg_utils"))
def test_msg_utils_needs_numpy_and_itself_only(name):
    # ROS's message classes come in by name (messages.py), so that rosbags' own do as well.
    assert strangers(name, ["numpy", "msg_utils"]) == []


def test_only_messages_of_msg_utils_imports_by_name():
    by_name = [name for name in files_in("msg_utils")
               if any(m.startswith("importlib") for m in imports(TREES[name]))]
    assert by_name == ["msg_utils/messages.py"]


OUTSIDE = [name for name in TREES
           if not name.startswith(("lidar_perception/nodes/", "lidar_perception/cli/"))]


@pytest.mark.parametrize("name", OUTSIDE)
def test_the_core_imports_no_ros_no_nodes_and_no_command_line(name):
    ros = {m for m in imports(TREES[name]) if m.partition(".")[0] in ROS}
    assert ros == set()
    above = [m for m in imports(TREES[name])
             if within(m, ["lidar_perception.nodes", "lidar_perception.cli"])]
    assert above == []


@pytest.mark.parametrize("name", files_in("lidar_perception/cli"))
def test_the_command_line_imports_no_ros_when_it_is_imported(name):
    ros = {m for m in imports(TREES[name], everywhere=False) if m.partition(".")[0] in ROS}
    assert ros == set()


@pytest.mark.parametrize("name", files_in("lidar_perception/ground", "lidar_perception/clustering",
                                          "lidar_perception/candidates"))
def test_algorithms_import_numbers_and_the_shared_files_only(name):
    assert strangers(name, NUMERIC + SHARED + ALGORITHMS) == []


NETWORKS = [f"lidar_perception.{name}"
            for name in ("checkpoint", "config_json", "devices", "param_fields")]


@pytest.mark.parametrize("name", files_in("lidar_perception/detection"))
def test_detectors_import_torch_and_the_algorithms(name):
    tensors = ["torch", "safetensors", "onnx", "onnxruntime", "onnxscript"]
    own = ["lidar_perception.detection", *NETWORKS]
    assert strangers(name, NUMERIC + tensors + SHARED + ALGORITHMS + own) == []


@pytest.mark.parametrize("name", files_in("lidar_perception/pointnet"))
def test_pointnet_imports_of_the_other_detector_what_is_not_its_network(name):
    shared = [f"lidar_perception.detection.{module}" for module in (
        "config", "detector_params", "network_detector", "nms", "view", "weights_file")]
    own = ["lidar_perception.pointnet", *NETWORKS, *shared]
    algorithms = [m for m in ALGORITHMS if not m.endswith("candidates")]
    assert strangers(name, NUMERIC + ["torch"] + SHARED + algorithms + own) == []


@pytest.mark.parametrize("name", files_in("lidar_perception/hybrid"))
def test_hybrids_import_the_detectors_that_they_join(name):
    joined = [f"lidar_perception.{module}" for module in (
        "hybrid", "pointnet", "detection.config", "detection.nms", "detection.view", "detectors",
        "pipeline", "camera", "configurations", "param_fields")]
    assert strangers(name, ["numpy", *SHARED, *ALGORITHMS, *joined]) == []


SHARED_TRAINING = [f"lidar_perception.training.{name}" for name in (
    "params", "schedule", "ranks", "log", "run", "loop", "augment", "putting", "database",
    "data")]


@pytest.mark.parametrize("module", SHARED_TRAINING)
def test_what_all_networks_train_with_knows_none_of_them(module):
    own = [*SHARED_TRAINING, "lidar_perception.param_fields", "lidar_perception.terminal"]
    assert strangers(f"{module.replace('.', '/')}.py", [*NUMERIC, "torch", *SHARED, *own]) == []


@pytest.mark.parametrize("name, allowed", [
    ("lidar_perception/types.py", []),
    ("lidar_perception/rotated_iou.py", ["numba"]),
    ("lidar_perception/geometry.py", []),
    ("lidar_perception/files.py", ["lidar_perception.types"]),
    ("lidar_perception/topics.py", []),
    ("lidar_perception/machine.py", []),
    ("lidar_perception/processes.py", ["lidar_perception.types"]),
    ("lidar_perception/resuming.py", ["lidar_perception.types"]),
    ("lidar_perception/checkpoint.py", ["torch", "safetensors", "lidar_perception.files",
                                        "lidar_perception.types"]),
    ("lidar_perception/devices.py", ["torch", "lidar_perception.types"]),
    ("lidar_perception/detectors.py", ["lidar_perception.checkpoint", "lidar_perception.detection",
                                       "lidar_perception.pointnet", "lidar_perception.params",
                                       "lidar_perception.types"]),
    ("lidar_perception/reproduction/paper.py", ["lidar_perception.params"]),
    ("lidar_perception/param_fields.py", []),
    ("lidar_perception/params.py", ["lidar_perception.param_fields"]),
    ("lidar_perception/camera.py", ["scipy", "numba", "lidar_perception.types"]),
    ("lidar_perception/pipeline.py", ["lidar_perception.camera", *SHARED, *ALGORITHMS]),
])
def test_the_shared_files_are_leaves(name, allowed):
    assert strangers(name, ["numpy", *allowed]) == []


@pytest.mark.parametrize("name", files_in("lidar_perception/datasets",
                                          "lidar_perception/simulation"))
def test_data_sources_know_no_algorithm(name):
    above = [*ALGORITHMS, "lidar_perception.detection", "lidar_perception.pointnet",
             "lidar_perception.detectors", "lidar_perception.hybrid", "lidar_perception.training",
             "lidar_perception.pipeline", "lidar_perception.evaluation"]
    assert [m for m in imports(TREES[name]) if within(m, above)] == []


@pytest.mark.parametrize("name", [n for n in OUTSIDE if "/reproduction/" not in n])
def test_experiments_are_on_top_of_the_core(name):
    found = [m for m in imports(TREES[name]) if within(m, ["lidar_perception.reproduction"])]
    assert all(within(m, ["lidar_perception.reproduction.paper"]) for m in found)


def test_modules_do_not_import_in_circles():
    modules = {name.removesuffix(".py").removesuffix("/__init__").replace("/", "."): tree
               for name, tree in TREES.items()}
    arrows = {m: {other for i in imports(tree, everywhere=False)
                  for other in (i, i.rpartition(".")[0]) if other in modules and other != m}
              for m, tree in modules.items()}
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


@pytest.mark.parametrize("name", [n for n in OUTSIDE if public_functions(TREES[n])])
def test_every_public_function_has_a_docstring(name):
    without = [node.name for node in public_functions(TREES[name])
               if isinstance(node, ast.FunctionDef) and not ast.get_docstring(node)]
    assert without == []


@pytest.mark.parametrize("name", TREES)
def test_every_module_says_what_it_is_for_and_is_no_room_for_odds_and_ends(name):
    assert ast.get_docstring(TREES[name]), "no docstring"
    parts = Path(name).with_suffix("").parts
    assert not {"utils", "util", "helpers", "common", "misc"} & set(parts)


@pytest.mark.parametrize("name", TREES)
def test_no_source_is_longer_than_a_reader_can_hold(name):
    assert len((ROOT / name).read_text(encoding="utf-8").splitlines()) <= MAX_LINES


@pytest.mark.parametrize("module, heavy", [
    ("lidar_perception.types", "numba torch matplotlib scipy sklearn rosbags rich click"),
    ("lidar_perception.params", "numba torch matplotlib scipy sklearn rosbags rich click numpy"),
    ("lidar_perception.topics", "numba torch matplotlib scipy sklearn rosbags rich click numpy"),
    ("lidar_perception.geometry", "numba torch matplotlib scipy sklearn"),
    ("lidar_perception.camera", "torch matplotlib sklearn"),
    ("lidar_perception.pipeline", "torch matplotlib sklearn rosbags rich click"),
    ("msg_utils.point_cloud2", "numba torch matplotlib scipy rosbags lidar_perception"),
    ("msg_utils.markers", "numba torch matplotlib scipy rosbags lidar_perception"),
    ("lidar_perception.detection.config", "numba torch matplotlib scipy sklearn rich click"),
    ("lidar_perception.detection.detector_params", "numba torch matplotlib scipy numpy click"),
    ("lidar_perception.detection.weights_file", "numba torch matplotlib scipy click"),
    ("lidar_perception.pointnet.config", "numba torch matplotlib scipy sklearn rich click"),
    ("lidar_perception.pointnet.params", "numba torch matplotlib scipy sklearn rich click"),
    ("lidar_perception.pointnet.weights_file", "numba torch matplotlib scipy click"),
    ("lidar_perception.pointnet.detector", "onnx onnxruntime matplotlib sklearn rich click"),
    ("lidar_perception.detection.expert", "torch matplotlib sklearn rosbags rich click"),
    ("lidar_perception.detection.detector", "onnx onnxruntime matplotlib sklearn rich click"),
    ("lidar_perception.training.params", "numba torch matplotlib scipy numpy rich click"),
    ("lidar_perception.cli.train", "numba torch matplotlib scipy"),
    ("lidar_perception.cli.weights", "numba torch matplotlib scipy"),
    ("lidar_perception.evaluation.candidates", "torch matplotlib sklearn click"),
    ("lidar_perception.evaluation.detection", "torch matplotlib sklearn rich click"),
    ("lidar_perception.evaluation.comparison", "torch matplotlib sklearn click"),
    ("lidar_perception.hybrid.params", "numba torch matplotlib scipy numpy rich click"),
    ("lidar_perception.cli.compare", "numba torch matplotlib scipy sklearn"),
    ("lidar_perception.evaluation.nuscenes", "torch matplotlib sklearn rich click rosbags"),
    ("lidar_perception.reproduction.stm_cpa", "torch matplotlib sklearn click jinja2 distributed"),
    ("lidar_perception.cli.reproduce", "numba torch matplotlib scipy sklearn jinja2 distributed"),
    ("lidar_perception.cli.main", "numba torch matplotlib scipy sklearn rosbags"),
])
def test_importing_a_module_does_not_load_what_it_does_not_need(module, heavy):
    code = f"import sys, {module}; print(*(sys.modules.keys() & set(sys.argv[1:])))"
    result = subprocess.run([sys.executable, "-c", code, *heavy.split(), "rclpy"], cwd=ROOT,
                            capture_output=True, text=True, check=True)
    assert result.stdout.split() == []
