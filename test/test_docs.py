"""Generated pages match the code, and links of all pages exist."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import pytest
import yaml

from lidar_perception.nodes import NODES, load_node_class
from lidar_perception.nodes.main import make_help_text
from lidar_perception.nodes.node_parameters import find_node_parameters
from lidar_perception.param_fields import collect_fields

pytestmark = pytest.mark.no_cover  # covered by other tests

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def generate():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", NODES)
def test_help_of_a_node_names_every_parameter(name):
    text = make_help_text(name)
    assert all(f"  {key} (" in text for key in find_node_parameters(name))


def test_every_node_has_a_page():
    assert {p.stem for p in (ROOT / "docs/reference/nodes").iterdir()} == set(NODES)


@pytest.mark.parametrize("name", NODES)
def test_pages_match_the_code(generate, name):
    page = ROOT / "docs" / "reference" / "nodes" / f"{name}.md"
    assert page.read_text() == generate.make_page(name), "run: python docs/generate.py"


def test_tables_of_the_papers_match_the_code(generate):
    assert generate.PAPERS.read_text() == generate.update_papers_page(), "run: python docs/generate.py"


def test_options_named_in_the_departures_table_exist():
    from experiments.departures import DEPARTURES
    from lidar_perception.candidates.params import PipelineParams
    from lidar_perception.detectors.pointpillars.config import make_config
    from lidar_perception.param_fields import with_values
    from lidar_perception.training.params import PointNetTraining

    for option in re.findall("`([^`]*)`", " ".join(row.option for row in DEPARTURES)):
        if match := re.fullmatch(r"([a-z_]+)='?([^']*)'?", option):  # argument of make_config
            kind = type(getattr(make_config(), match[1]))
            make_config(**{match[1]: kind(match[2])})
        elif match := re.fullmatch(r"train pointnet --network (\S+)", option):
            with_values(PointNetTraining(), {"network": match[1]})
        elif "." in option:
            name, _, value = option.partition(": ")
            assert name in collect_fields(PipelineParams()), option
            if value:
                with_values(PipelineParams(), {name: yaml.safe_load(value)})


@pytest.mark.parametrize(
    "name",
    [
        "ground_segmentation",
        "clustering",
        "candidate_refinement",
        "perception",
        "evaluator",
        "pointpillars_detector",
        "pointnet_detector",
        "fused_detector",
        "tracker",
    ],
)
def test_documented_topics_are_those_of_the_node(generate, name, domain):
    pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    from lidar_perception.nodes.external_node import create_context, shut_down_context

    context = create_context(domain)
    node = load_node_class(name)(context=context)
    node.start()
    listed = {
        t
        for t, _ in [
            *node.get_publisher_names_and_types_by_node(name, "/"),
            *node.get_subscriber_names_and_types_by_node(name, "/"),
        ]
    }
    watched = node.autostart.inputs if hasattr(node, "autostart") else ()
    assert {node.resolve_topic_name(f"~/input/{t}") for t in watched} >= {
        reception.topic for reception in node.inputs.receptions
    }
    shut_down_context(context, node)
    documented = set()
    for topics, kind, _ in generate.list_inputs(name) + generate.list_outputs(name):
        first, *others = topics.split(", ")
        names = [first, *(f"{first.rsplit('/', 1)[0]}/{o}" for o in others)]
        if not (kind.startswith("vision_msgs") or ("_ms" in topics and "processing" not in topics)):
            documented |= {
                ("" if n[0] in "~/" else "/") + n.replace("~", f"/{name}").replace("STAGE", "final") for n in names
            }
    listed = {t for t in listed if not t.endswith("_ms") or "processing" in t}  # one row covers all times
    standard = {"/parameter_events", "/rosout", "/clock", "/tf_static"}
    assert listed - standard == documented


@pytest.mark.parametrize(
    "page", [*ROOT.glob("docs/**/*.md"), ROOT / "README.md"], ids=lambda p: str(p.relative_to(ROOT))
)
def test_link_targets_exist(page):
    for target in re.findall(r"\]\(([^)#]+)", page.read_text()):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_best_parameter_file_matches_the_code(generate):
    from lidar_perception.candidates.configurations import BEST_VALUES
    from lidar_perception.candidates.params import PipelineParams
    from lidar_perception.cli.options import read_config
    from lidar_perception.param_fields import with_values

    assert generate.BEST.read_text() == generate.make_best_file(), "run: python docs/generate.py"
    assert with_values(PipelineParams(), read_config(generate.BEST, PipelineParams())) == with_values(
        PipelineParams(), BEST_VALUES
    )
    assert read_config(Path("best"), PipelineParams()) == BEST_VALUES


@pytest.mark.parametrize("network", ["pointpillars", "pointnet", "fused"])
def test_nodes_of_a_detector_graph_share_parameters(generate, network):
    from lidar_perception.candidates.params import PipelineParams
    from lidar_perception.cli.options import read_config
    from lidar_perception.param_fields import with_values
    from lidar_perception.params import ClusteringNodeParams, GroundNodeParams

    file = generate.find_config_file(network)
    assert file.read_text() == generate.make_config_file(network), "run: python docs/generate.py"
    values = read_config(file, PipelineParams())
    detector = generate.make_detector_params(network)
    for params in GroundNodeParams(), ClusteringNodeParams():
        known = collect_fields(params)
        own = with_values(params, {k: v for k, v in values.items() if k in known})
        for group in ("input", "ground", "clustering"):
            assert getattr(own, group, None) in (None, getattr(detector, group))
    assert with_values(detector, values) == detector
