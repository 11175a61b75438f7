"""Selection of the topics of a running graph to show: the cloud topic with the most columns, and its boxes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lidar_perception.data.to_bag import MARKERS
from lidar_perception.types import InputError
from lidar_perception.wire.clouds import POINT_CLOUD
from lidar_perception.wire.topics import DETECTIONS, POINTS, TRUTH
from lidar_perception.wire.topics import TRACKS as TRACKED
from lidar_studio.live_graph import BOXES, LABELS, TRACKS
from lidar_studio.results import CLUSTERED_TOPICS

ARRAY = "vision_msgs/msg/Detection3DArray"
# Suffixes of cloud topics in order of preference: topics with more columns first.
CLOUD_SUFFIXES = tuple(topic.lstrip("/") for topic in (*CLUSTERED_TOPICS, "/ground_segmentation/output/points", POINTS))
KIND_BY_SUFFIX = {DETECTIONS: BOXES, TRACKED: TRACKS, TRUTH: LABELS}
ARRAY_SUFFIX = "_3d"  # suffix of a Detection3DArray topic with the same boxes as a MarkerArray topic


def parse_namespace(topic: str) -> str:
    """Return the namespace of the node that publishes a topic, "" for the root.

    It is NS for /NS/NODE/output/NAME and /NS/ground_truth/detections. For other topics, it is the part
    before the last slash.
    """
    parts = topic.removesuffix(ARRAY_SUFFIX).strip("/").split("/")
    name_length = 3 if parts[-2:-1] == ["output"] else 2 if parts[-2:] == TRUTH.strip("/").split("/") else 1
    return "/".join(parts[:-name_length])


def is_in_namespace(topic: str, namespace: str) -> bool:
    """Return True if the node that publishes a topic is in a namespace or below it.

    The namespace "" contains all topics; "/" contains only topics in the root.
    """
    prefix = namespace.strip("/")
    if prefix:
        return topic.startswith(f"/{prefix}/")
    return not namespace or not parse_namespace(topic)


def resolve_topic(topic: str, namespace: str) -> str:
    """Return the absolute name of a topic that may be relative to the namespace."""
    parts = [] if topic.startswith("/") else [namespace.strip("/")]
    return "/" + "/".join(filter(None, (*parts, topic.strip("/"))))


def select_cloud_topic(types: Mapping[str, str], namespace: str = "", requested_topic: str = "") -> str:
    """Select the requested cloud topic, otherwise the one with the most columns or the only one.

    Args:
        types: Types of the published topics, by name.

    Raises:
        InputError: There is no such topic, or the choice is ambiguous.
    """
    cloud_topics = sorted(t for t, kind in types.items() if kind == POINT_CLOUD)
    in_namespace = f" in namespace {namespace}" if namespace else ""
    if requested_topic:
        full_name = resolve_topic(requested_topic, namespace)
        if full_name not in cloud_topics:
            raise InputError(
                f"no point clouds are published on {full_name}; cloud topics: {', '.join(cloud_topics) or 'none'}"
            )
        return full_name
    candidates = [t for t in cloud_topics if is_in_namespace(t, namespace)]
    if not candidates:
        raise InputError(
            f"no point clouds are published{in_namespace}; check that the graph is running with this ROS_DOMAIN_ID"
            + (f" (cloud topics elsewhere: {', '.join(cloud_topics)})" if cloud_topics else "")
        )
    for suffix in CLOUD_SUFFIXES:
        if matches := [t for t in candidates if t.endswith(f"/{suffix}") or t.endswith(f"_{suffix}")]:
            candidates = matches
            break
    if len(candidates) > 1:
        raise InputError(
            f"several topics have point clouds: {', '.join(candidates)}; choose one with --topic"
            + ("" if namespace else " or --namespace")
        )
    return candidates[0]


def select_box_topics(
    types: Mapping[str, str], clouds: str, namespace: str = "", requested_topics: Iterable[str] = ()
) -> dict[str, str]:
    """Select the box topics that belong to a cloud topic.

    A Detection3DArray topic with the same boxes as a MarkerArray topic is skipped.

    Args:
        types: Types of the published topics, by name.
        requested_topics: Topics of detections, empty for all.

    Returns:
        BOXES, TRACKS or LABELS for each selected topic.
    """
    kind_by_topic = {}
    for topic, kind in types.items():
        if kind not in (MARKERS, ARRAY):
            continue
        marker_topic = topic.removesuffix(ARRAY_SUFFIX) if kind == ARRAY else topic
        if kind == ARRAY and types.get(marker_topic) == MARKERS:
            continue
        for suffix, box_kind in KIND_BY_SUFFIX.items():
            if marker_topic.endswith(suffix):
                kind_by_topic[topic] = box_kind
    box_namespace = namespace or _infer_namespace(clouds, kind_by_topic)
    kind_by_topic = {t: k for t, k in kind_by_topic.items() if is_in_namespace(t, box_namespace)}
    full_names = [resolve_topic(t, namespace) for t in requested_topics]
    if full_names:
        kind_by_topic = {t: k for t, k in kind_by_topic.items() if k != BOXES}
        kind_by_topic |= {t: BOXES for t in full_names if types.get(t) in (MARKERS, ARRAY)}
    return kind_by_topic


def _infer_namespace(clouds: str, box_topics: Mapping[str, str]) -> str:
    """Infer the namespace of the boxes that belong to a cloud topic, as expected by is_in_namespace().

    The nodes of this package publish clouds and boxes in the same namespace. A driver's topic may be
    named after the sensor, such as /ouster/points, so the nearest parent namespace with boxes is used.
    If only one robot publishes boxes, all boxes belong to the cloud, unless the cloud topic is NS/points,
    which may belong to another robot.
    """
    cloud_namespace = parse_namespace(clouds)
    if "/output/" in clouds:
        return cloud_namespace or "/"
    box_namespaces = {parse_namespace(topic) for topic, kind in box_topics.items() if kind != LABELS}
    parents = [parent for parent in box_namespaces if not parent or clouds.startswith(f"/{parent}/")]
    is_single_robot = len(box_namespaces) < 2 and (parents or not cloud_namespace or not clouds.endswith(POINTS))
    return "" if is_single_robot else max(parents, key=len, default=cloud_namespace) or "/"
