"""Nodes and parameters that the launch files start, with a stand-in for launch and launch_ros."""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path

import pytest
from launch_stand_in import Launch, install

from lidar_perception.nodes import graph as graph_module
from lidar_perception.nodes.graph import build_graph, find_result_node
from lidar_perception.nodes.main import split_arguments
from lidar_perception.nodes.node_parameters import find_node_parameters
from lidar_perception.nodes.param_files import read_sections
from lidar_perception.types import InputError

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def load_launch_file(monkeypatch):
    """Return load_launch_file(name)(**arguments), which executes a launch file and returns {name: node}. Its attribute
    `messages` has the log of the last call.
    """
    install(monkeypatch)

    def load(name):
        def nodes(**arguments):
            launch = Launch(name, {"processes": "true"} | arguments)
            nodes.messages = launch.messages
            return {n.name if n.executable == "tracker" else n.executable: n for n in launch.nodes}

        return nodes

    return load


FILES = {
    "perception": "candidates",
    "pointpillars": "pointpillars",
    "pointnet": "pointnet",
    "fused": "fused",
    "detectors": "fused",
}
SEVERAL = "candidates,pointpillars,pointnet"


KEEP_REFLECTIONS = {"ground.patchwork.remove_reflections": False}


@pytest.mark.parametrize("name", FILES)
def test_launch_file_starts_its_graph_or_single_detectors(name, load_launch_file):
    nodes = load_launch_file(name)
    detectors = FILES[name].split(",")
    config = str(ROOT / "config" / f"{'fused' if name == 'detectors' else name}.param.yaml")
    node_by_name = nodes(points="/cloud", use_sim_time="true", log_level="debug", reliability="reliable")
    assert list(node_by_name) == list(build_graph(detectors))
    assert list(nodes(single="true")) == list(build_graph(detectors, single=True))
    assert ("~/input/points", "/cloud") in node_by_name["ground_segmentation"].remappings
    assert ("~/input/points", "ground_segmentation/output/points") in (node_by_name["clustering"].remappings)
    for node in node_by_name.values():
        assert Path(node.parameters[0]).is_file() and node.namespace is None
        assert node.parameters[1] == {"use_sim_time": True, "input.reliability": "reliable"}
        assert node.ros_arguments == ["--log-level", "debug"]
        if not node.name.endswith("_detector"):
            assert node.parameters[0] == config
    assert not any(node.respawn for node in node_by_name.values())
    restarted = nodes(respawn="true", rviz="true", tracking="true")
    assert all(node.respawn == (kind != "rviz2") for kind, node in restarted.items())
    for node in nodes(autostart="false").values():
        assert node.parameters[1] == {"autostart": False}  # other parameters are those of the file
    mine = str(ROOT / "config" / "best.param.yaml")
    for node in nodes(config=mine, tracking="true").values():  # in addition to the package's file
        assert node.parameters[0] != node.parameters[1] == mine
    frames = {"base_frame": "base", "target_frame": "odom"}
    for node in nodes(deskew="odometry", odometry="/odometry", **frames).values():
        assert frames.items() < node.parameters[1].items()
        assert node.parameters[1]["input.deskew"] == "odometry"
        assert ("~/input/odometry", "/odometry") in node.remappings
    assert all(n.parameters[1]["input.ahead"] == 180.0 for n in nodes(ahead="180").values())
    with pytest.raises(InputError, match="ahead:=left is not a number"):
        nodes(ahead="left")


@pytest.mark.parametrize(
    ("processes", "cores", "together"), [("true", 2, False), ("false", 16, True), ("auto", 4, True), ("auto", 5, False)]
)
def test_graph_is_one_process_if_requested_or_on_few_cores(processes, cores, together, load_launch_file, monkeypatch):
    monkeypatch.setattr(graph_module, "count_cores", lambda: cores)
    nodes = load_launch_file("detectors")
    arguments = dict(
        processes=processes,
        tracking="true",
        namespace="left",
        range="around",
        points="/cloud",
        log_level="debug",
        respawn="true",
    )
    node_by_name = nodes(**arguments)
    graph = build_graph(["fused"], tracking=True)
    assert len(node_by_name) == (1 if together else len(graph))
    assert len(nodes(**arguments | {"tracking": "false"}, single="true")) == 1
    if not together:
        return
    (node,) = node_by_name.values()
    assert (node.namespace, node.respawn, node.ros_arguments) == ("left", True, ["--log-level", "debug"])
    parts, shared = split_arguments([node.executable, *node.arguments, "--ros-args", "-r", "a:=b"])
    assert [part[0] for part in parts] == [*graph] and shared == ["--ros-args", "-r", "a:=b"]
    for part, name in zip(parts, graph):
        own_node = nodes(**arguments | {"processes": "true"})[name]
        options = list(zip(part[2::2], part[3::2]))
        assert [tuple(rule.split(":=")) for option, rule in options if option == "-r"] == [
            ("__node", name),
            *own_node.remappings,
        ]
        files = [file for option, file in options if option == "--params-file"]
        for file, parameters in zip(files, own_node.parameters, strict=True):
            assert read_sections(file) == (
                read_sections(parameters) if isinstance(parameters, str) else {"/**": parameters}
            )


@pytest.mark.parametrize(
    ("detectors", "given", "expected"),
    [
        ("fused", {}, {"range": "ahead"}),
        ("pointpillars,fused", {}, {"range": "ahead"}),
        ("pointnet,fused", {}, {}),
        ("fused", {"range": "around"}, {"range": "around"}),
        ("candidates", {}, {}),
        ("fused", {"weights": "mine.safetensors"}, {}),
        ("pointpillars,fused", {"config": "fused.range: around"}, {}),
        ("fused", {"config": "fused.range: around"}, {"range": "around"}),
        ("fused", {"config": "range: all"}, {}),
        ("fused", {"config": "fused.use_intensity: false"}, {"range": "ahead"} | KEEP_REFLECTIONS),
        ("pointnet", {"config": "pointnet.use_intensity: false"}, KEEP_REFLECTIONS),
        ("pointnet,fused", {"config": "fused.use_intensity: false"}, {}),
    ],
)
def test_expert_parameters_follow_from_the_detectors(detectors, given, expected, load_launch_file, tmp_path):
    nodes = load_launch_file("detectors")
    if "config" in given:
        mine = tmp_path / "mine.yaml"
        mine.write_text(f"/**: {{ros__parameters: {{{given['config']}}}}}")
        given = {"config": str(mine)}
    *_, last = nodes(detectors=detectors, **given)["ground_segmentation"].parameters
    names = {"range", *KEEP_REFLECTIONS}
    assert ({name: last[name] for name in names & {*last}} if isinstance(last, dict) else {}) == expected


@pytest.mark.parametrize("detectors", ["pointnet,pointpillars", "pointpillars,pointnet"])
def test_first_detector_sets_parameters_of_ground_and_clusters(detectors, load_launch_file):
    node_by_name = load_launch_file("detectors")(detectors=detectors)
    files = {name: Path(node.parameters[0]).name.split(".")[0] for name, node in node_by_name.items()}
    assert files["ground_segmentation"] == files["clustering"] == detectors.split(",")[0]
    assert all(files[f"{name}_detector"] == name for name in detectors.split(","))


def test_arguments_override_user_file_and_defaults(load_launch_file, tmp_path):
    """rcl prefers a section with a node's name to /**, the only section of the package's files."""
    for file in (ROOT / "config").glob("*.param.yaml"):
        assert list(read_sections(file)) == ["/**"]
    nodes = load_launch_file("fused")
    mine = tmp_path / "mine.yaml"
    mine.write_text(
        "/**/fused_detector: {ros__parameters: {fused: {range: ahead}}}\n"
        "left: {clustering: {ros__parameters: {clustering.density: 1.0}}}\n"
    )
    node_by_name = nodes(config=f"{ROOT}/config/best.param.yaml,{mine}", range="around")
    *files, argument_values, argument_file = node_by_name["fused_detector"].parameters
    assert [Path(file).name for file in files] == ["fused.param.yaml", "best.param.yaml", "mine.yaml"]
    assert (
        read_sections(argument_file)
        == {"/**/fused_detector": argument_values}
        == {"/**/fused_detector": {"fused.range": "around"}}
    )
    assert node_by_name["clustering"].parameters[1:] == files[1:]
    assert nodes.messages == []


@pytest.mark.parametrize(
    "section, words",
    [
        ("fused_detectr", "unknown node 'fused_detectr'.*; did you mean 'fused_detector'"),
        ("/left/ground_segmentaton", "'ground_segmentaton'.* 'ground_segmentation'"),
        ("controller_server", "unknown node 'controller_server'; its parameters are ignored$"),
        ("/**", ""),
        ("/*", ""),
        ("/left/**", ""),
        ("/**/clustering", ""),
        ("left/fused_detector", ""),
        ("front_fused_detector", ""),
        ("perception", ""),
    ],
)  # the package's nodes in another graph
def test_section_of_unknown_node_is_a_warning(section, words, load_launch_file, tmp_path):
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"{section}:\n  ros__parameters: {{input.queue: 2}}\n")
    nodes = load_launch_file("fused")
    assert len(nodes(config=str(mine))) == 3
    assert [bool(re.search(words, line)) for line in nodes.messages] == [True] * bool(words)


@pytest.mark.parametrize(
    "name, given, words",
    [
        ("fused", "pionts", "unknown launch argument 'pionts'; did you mean 'points'?"),
        ("fused", "fused.scores.car", "a parameter of fused_detector; set it in a parameter file"),
        ("detectors", "zzz", "unknown launch argument 'zzz'; valid names: ahead, autostart"),
        ("replay", "real_tme", "did you mean 'real_time'"),
        ("replay", "namespace", "unknown launch argument 'namespace'"),
        ("two_lidars", "lft", "did you mean 'left'"),
    ],
)
def test_unknown_launch_argument_is_rejected(name, given, words, load_launch_file, drive_bag):
    with pytest.raises(InputError, match=re.escape(words)):
        load_launch_file(name)(**{given: "1"}, **({"bag": str(drive_bag)} if name == "replay" else {}))


def test_replay_declares_the_arguments_of_its_graph(load_launch_file):
    """`ros2 launch --show-args` lists declared arguments only."""
    from lidar_perception.nodes.launching import ARGUMENTS

    spec = importlib.util.spec_from_file_location("replay", ROOT / "launch" / "replay.launch.py")
    file = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(file)
    names = {getattr(entity, "name", None) for entity in file.generate_launch_description().entities}
    assert names >= ARGUMENTS.keys() - {"namespace", "name_prefix"}
    assert not names & {"namespace", "name_prefix"}


@pytest.mark.parametrize("name, given", [("fused", "points"), ("fused", "launch-prefix"), ("two_lidars", "range")])
def test_known_launch_argument_is_accepted(name, given, load_launch_file):
    assert load_launch_file(name)(**{given: "auto"})


def test_second_sensor_has_its_own_names(load_launch_file):
    nodes = load_launch_file("detectors")
    for node in nodes(namespace="left").values():
        assert node.namespace == "left"
        assert not any(topic.startswith("/") for _, topic in node.remappings)
    node_by_name = nodes(name_prefix="left_", detectors="pointnet")
    assert [n.name for n in node_by_name.values()] == ["left_" + n for n in node_by_name]
    assert node_by_name["clustering"].remappings == [
        ("~/input/points", "left_ground_segmentation/output/points"),
        ("~/input/odometry", "odom"),
    ]
    assert ("~/input/points", "points") in node_by_name["ground_segmentation"].remappings


def test_tracking_adds_a_tracker_to_each_detector(load_launch_file):
    nodes = load_launch_file("detectors")
    node_by_name = nodes(
        tracking="true", odometry="/odometry", points="/cloud", namespace="left", name_prefix="a_", detectors=SEVERAL
    )
    trackers = {name: node for name, node in node_by_name.items() if node.executable == "tracker"}
    assert list(trackers) == [f"a_{name}_tracker" for name in SEVERAL.split(",")]
    behind = trackers["a_pointnet_tracker"]
    found = "a_pointnet_detector/output/detections"
    assert dict(behind.remappings) == {
        "~/input/points": "/cloud",
        "~/input/odometry": "/odometry",
        "~/input/detections": found,
    }
    assert behind.namespace == "left"
    [file] = behind.parameters
    assert Path(file).name == "tracker.param.yaml" and Path(file).is_file()
    single_nodes = nodes(tracking="true", detectors="pointpillars")
    assert ("~/input/detections", "pointpillars_detector/output/detections") in (single_nodes["tracker"].remappings)
    assert "tracker" not in nodes(detectors="pointpillars")


def test_single_process_tracks_inside_the_detector(load_launch_file):
    nodes = load_launch_file("detectors")
    for name, node in nodes(tracking="true", single="true").items():
        assert node.executable != "tracker" and node.parameters[1]["tracking.enabled"] is True
        assert "tracking.enabled" in find_node_parameters(name)
        assert ("~/input/odometry", "odom") in node.remappings


def test_rviz_topics_follow_the_names_of_the_graph(load_launch_file):
    nodes = load_launch_file("detectors")
    assert "rviz2" not in nodes()
    plain = nodes(rviz="true", detectors=SEVERAL, points="/cloud", rviz_frame="base_link", namespace="left")["rviz2"]
    assert dict(plain.remappings) == {"points": "/cloud", "tracker/output/tracks": "candidates_tracker/output/tracks"}
    assert plain.namespace == "left"
    assert plain.arguments == ["-d", str(ROOT / "config/lidar_perception.rviz"), "-f", "base_link"]
    prefixed = dict(nodes(rviz="true", detectors=SEVERAL, name_prefix="left_")["rviz2"].remappings)
    assert prefixed["clustering/output/points"] == "left_clustering/output/points"
    assert prefixed["tracker/output/tracks"] == "left_candidates_tracker/output/tracks"
    assert not {"points", "clicked_point"} & set(prefixed)  # not of the package's nodes
    single = dict(nodes(rviz="true", detectors=SEVERAL, single="true")["rviz2"].remappings)
    assert single["clustering/output/points"] == "perception/output/points"
    assert single["candidate_refinement/output/detections"] == "perception/output/detections"
    assert single["tracker/output/tracks"] == "perception/output/tracks"
    assert "pointnet_detector/output/detections" not in single


@pytest.mark.parametrize("name", ["pointpillars", "pointnet", "fused"])
def test_weights_device_and_range_of_a_detector_are_arguments(name, load_launch_file):
    expected = {f"{name}.weights": "w.safetensors", f"{name}.device": "cpu"}
    if name != "pointnet":  # always uses the full range
        expected[f"{name}.range"] = "around"
    for file, weights in (name, "w.safetensors"), ("detectors", f"{name}=w.safetensors"):
        nodes = load_launch_file(file)
        node_by_name = nodes(
            weights=weights,
            device="cpu",
            range="around",
            detectors=name if file == name else "pointnet,pointpillars,fused",
        )
        assert node_by_name[f"{name}_detector"].parameters[1] == expected


@pytest.mark.parametrize("single", ["false", "true"])
@pytest.mark.parametrize("detectors", ["candidates", "fused", "candidates,pointpillars"])
def test_replay_connects_player_nodes_and_evaluator(detectors, single, load_launch_file, drive_bag):
    """Also if an including file has arguments of these names."""
    nodes = load_launch_file("replay")
    node_by_name = nodes(bag=str(drive_bag), detectors=detectors, single=single, scores="scores.json", processes="true")
    names = detectors.split(",")
    assert {*node_by_name} == {*build_graph(names, single == "true"), "bag_player", "evaluator"}
    found = {name: f"{find_result_node(name, single == 'true')}/output/detections" for name in names}
    player, evaluator = node_by_name["bag_player"].parameters[-1], node_by_name["evaluator"].parameters[-1]
    assert player["follow"] == [*found.values()]
    assert {f"{topic}:=2" for topic in found.values()} < {*player["wait_for"]}  # evaluator, player
    by_paper = names == ["candidates"]
    assert evaluator["stages"] == (
        ["stage1", "stage2", "final"] if by_paper else ["final"] if len(names) == 1 else names
    )
    assert evaluator.get("classes") == (["Pedestrian"] if by_paper else None)
    remapped = dict(node_by_name["evaluator"].remappings)
    assert set(found.values()) < {*remapped.values()}
    assert ("~/input/camera_info" in remapped) != by_paper
    for node in build_graph(names, single == "true"):
        files = [Path(f).name for f in node_by_name[node].parameters if isinstance(f, str)]
        assert "replay.param.yaml" in files
        assert ("replay_candidates.param.yaml" in files) == ("candidates" in names)


@pytest.mark.parametrize(
    "given, words",
    [
        ({"detectors": "candidates,dream"}, "'dream' is unknown; choose from candidates, pointpillars, pointnet"),
        ({"detectors": ""}, "detectors is empty"),
        ({"detectors": SEVERAL, "weights": "w.safetensors"}, "NAME=FILE"),
        ({"detectors": SEVERAL, "weights": "v5=w"}, "'v5' is not one of"),
        ({"config": "all.yaml"}, "config: parameter file not found: all.yaml"),
    ],
)
def test_unusable_launch_argument_is_rejected(given, words, load_launch_file):
    with pytest.raises(InputError, match=words):
        load_launch_file("detectors")(**given)


@pytest.mark.parametrize("path", sorted((ROOT / "test/launch").glob("*.py")), ids=lambda p: p.stem)
def test_modules_imported_by_launch_tests_exist(path):
    """The launch tests run only where launch_testing is installed."""
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("lidar_perception"):
            module = importlib.import_module(str(node.module))
            assert all(hasattr(module, alias.name) for alias in node.names), ast.unparse(node)
