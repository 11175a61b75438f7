"""Topics and types that the files for RViz, Foxglove and Nav2 expect exist in the graph."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from rclpy.qos import DurabilityPolicy, QoSCompatibility, QoSProfile, ReliabilityPolicy
from rclpy.qos import qos_check_compatible as compatible

from lidar_perception.data.bag import Bag
from lidar_perception.ground.obstacles import find_obstacles
from lidar_perception.ground.params import ObstacleParams
from lidar_perception.ground.segment import segment_ground
from lidar_perception.nodes import load_node_class
from lidar_perception.nodes.external_node import create_context, shut_down_context
from lidar_perception.nodes.graph import DETECTOR_NODES, SINGLE_PROCESS_CANDIDATES, build_graph
from lidar_perception.wire.messages import to_point_cloud
from lidar_perception.wire.topics import POINTS
from msg_utils.point_cloud2 import to_array

CONFIG = Path(__file__).resolve().parents[2] / "config"
NAV2 = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "nav2.md"
CLOUD, MARKERS = "sensor_msgs/msg/PointCloud2", "visualization_msgs/msg/MarkerArray"
# Nav2's obstacle_layer.cpp (jazzy) and spatio_temporal_voxel_layer.cpp
NAV2_QOS = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
SOURCE = {
    "topic": str,
    "data_type": str,
    "marking": bool,
    "clearing": bool,
    "min_obstacle_height": float,
    "max_obstacle_height": float,
    "expected_update_rate": float,
}
PLANAR = SOURCE | {"obstacle_max_range": float, "raytrace_max_range": float}
LAYERS = {  # parameters of each layer in nav2.md and of its sources
    "nav2_costmap_2d::ObstacleLayer": ({"min_obstacle_height": float, "max_obstacle_height": float}, PLANAR),
    "nav2_costmap_2d::VoxelLayer": (
        {
            "min_obstacle_height": float,
            "max_obstacle_height": float,
            "origin_z": float,
            "z_resolution": float,
            "z_voxels": int,
        },
        PLANAR,
    ),
    "spatio_temporal_voxel_layer/SpatioTemporalVoxelLayer": (
        {"voxel_decay": float, "voxel_size": float},
        SOURCE | {"obstacle_range": float},
    ),
}
RVIZ = {
    "rviz_default_plugins/PointCloud2": CLOUD,
    "rviz_default_plugins/MarkerArray": MARKERS,
    "rviz_default_plugins/PublishPoint": "geometry_msgs/msg/PointStamped",
}


@pytest.fixture(scope="module")
def graph_topics(domain):
    """Return {topic: type} and {topic: QoS of its publishers} of all nodes as launch files start
    them."""
    context = create_context(domain)
    nodes, types, offered = [], {}, {}
    for name, remap in {
        **build_graph([*DETECTOR_NODES]),
        **SINGLE_PROCESS_CANDIDATES,
        **build_graph(["candidates"], tracking=True),
    }.items():
        rules = [word for rule in remap.items() for word in ("-r", ":=".join(rule))]
        node = load_node_class(name)(context=context, cli_args=["--ros-args", *rules])
        node.start()  # creates the topics of managed nodes
        nodes.append(node)
        types.update((t, kinds[0]) for t, kinds in node.get_subscriber_names_and_types_by_node(name, "/"))
        for topic, kinds in node.get_publisher_names_and_types_by_node(name, "/"):
            types[topic] = kinds[0]
            offered[topic] = node.get_publishers_info_by_topic(topic)[0].qos_profile
    yield types, offered
    shut_down_context(context, *nodes)


def load_rviz_manager():
    return yaml.safe_load((CONFIG / "lidar_perception.rviz").read_text())["Visualization Manager"]


def test_every_topic_of_the_rviz_file_is_in_the_graph(graph_topics):
    types, offered = graph_topics
    manager = load_rviz_manager()
    displays = [d for d in manager["Displays"] + manager["Tools"] if "Topic" in d]
    assert {"clustering/output/points", "clicked_point"} < {d["Topic"]["Value"] for d in displays}
    for display in displays:
        topic, policy = f"/{display['Topic']['Value']}", display["Topic"]["Reliability Policy"]
        assert types[topic] == RVIZ[display["Class"]], topic
        requested_qos = QoSProfile(
            depth=5, reliability=ReliabilityPolicy.get_from_short_key(policy.lower().replace(" ", "_"))
        )
        if topic in offered:
            assert compatible(offered[topic], requested_qos)[0] != QoSCompatibility.ERROR, topic


def test_every_topic_of_the_foxglove_layout_is_in_the_graph(graph_topics):
    types, _ = graph_topics
    panels = json.loads((CONFIG / "foxglove_layout.json").read_text())["configById"]
    for name, panel in panels.items():
        kind = name.partition("!")[0]
        if kind == "3D":
            assert panel["topics"]
            for topic, how in panel["topics"].items():
                assert types[topic] == (CLOUD if "colorMode" in how else MARKERS), topic
            assert types[panel["publish"]["pointTopic"]] == "geometry_msgs/msg/PointStamped"
        elif kind == "Plot":
            for path in panel["paths"]:
                topic, _, field = path["value"].partition(".")
                assert (types[topic], field) == ("std_msgs/msg/Float64", "data")
        else:
            assert kind == "DiagnosticSummary"
            assert types[panel["topicToRender"]] == "diagnostic_msgs/msg/DiagnosticArray"


def test_rviz_and_foxglove_show_the_same_topics():
    layout = json.loads((CONFIG / "foxglove_layout.json").read_text())["configById"]
    topics = next(p["topics"] for n, p in layout.items() if n.startswith("3D!"))
    displays = [d for d in load_rviz_manager()["Displays"] if "Topic" in d]
    assert {f"/{d['Topic']['Value']}": d["Enabled"] for d in displays} == {
        topic: how["visible"] for topic, how in topics.items()
    }


def load_costmap_layers():
    """Return (plugin, parameters) of each recipe in nav2.md."""
    for block in re.findall(r"```yaml\n(.*?)```", NAV2.read_text(), re.S):
        params = yaml.safe_load(block)["local_costmap"]["local_costmap"]["ros__parameters"]
        for name in params["plugins"]:
            if name in params:
                yield params[name]["plugin"], params[name]


def test_nav2_recipes_match_the_published_obstacles(graph_topics):
    types, offered = graph_topics
    assert {plugin for plugin, _ in load_costmap_layers()} == set(LAYERS)
    for plugin, layer in load_costmap_layers():
        known, of_source = LAYERS[plugin]
        sources = layer["observation_sources"].split()
        for key in set(layer) - {"plugin", "observation_sources", *sources}:
            assert type(layer[key]) is known[key], key
        for source in sources:
            assert all(type(value) is of_source[key] for key, value in layer[source].items())
            topic = layer[source]["topic"]
            assert types[topic] == CLOUD and layer[source]["data_type"] == "PointCloud2"
            assert compatible(offered[topic], NAV2_QOS)[0] != QoSCompatibility.ERROR


def test_costmap_gets_the_obstacles_of_each_cloud(processes, peer, drive_bag):
    """Obstacles of both nodes equal the offline ones and have the cloud's header and Nav2's layout."""
    with Bag(drive_bag) as bag:
        cloud = next(m for _, _, m in bag.messages({POINTS}))
    band = {"obstacles.min_height": 0.2, "obstacles.max_height": 2.5}
    messages = {}
    for node in ("ground_segmentation", "perception"):
        processes.start(node, {"~/input/points": "/in"}, band)
        messages[node] = peer.listen(f"/{node}/output/obstacles", CLOUD, NAV2_QOS)
    talker = peer.advertise("/in", CLOUD)
    peer.wait(lambda: talker.get_subscription_count() == 2, "both nodes")
    peer.send(talker, cloud, lambda: all(messages.values()), "obstacles of both")
    frame, indices = to_point_cloud(cloud)
    ground = segment_ground(frame)
    obstacles = find_obstacles(frame.xyz, ground, ObstacleParams(0.2, 2.5))
    assert 0 < obstacles.sum() < (~ground).sum()
    sent = to_array(cloud)[indices[obstacles]]
    for message, *_ in messages.values():
        assert [(f.name, f.datatype) for f in message.fields] == [(name, 7) for name in ("x", "y", "z", "intensity")]
        assert message.header == cloud.header
        np.testing.assert_array_equal(to_array(message), sent)
