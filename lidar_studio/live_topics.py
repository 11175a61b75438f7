"""Selection of the topics of a running graph to show: the clouds with the most columns, and their
boxes."""

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
# Suffixes of cloud topics, those with the most columns first.
CLOUD_ENDINGS = tuple(topic.lstrip("/") for topic in (*CLUSTERED_TOPICS, "/ground_segmentation/output/points", POINTS))
KIND_BY_ENDING = {DETECTIONS: BOXES, TRACKED: TRACKS, TRUTH: LABELS}
ARRAY_SUFFIX = "_3d"  # suffix of the Detection3DArray topic that accompanies a topic of markers


def parse_namespace(topic: str) -> str:
    """Return the namespace of the node that publishes a topic, from the name of the topic.

    NS for /NS/NODE/output/NAME and /NS/ground_truth/detections, else the part before the last
    slash; "" is the root.
    """
    parts = topic.removesuffix(ARRAY_SUFFIX).strip("/").split("/")
    name_length = 3 if parts[-2:-1] == ["output"] else 2 if parts[-2:] == TRUTH.strip("/").split("/") else 1
    return "/".join(parts[:-name_length])


def is_in_namespace(topic: str, namespace: str) -> bool:
    """Return True if the node of a topic is in a namespace or below it.

    The namespace "" contains all topics, "/" only those in the root.
    """
    prefix = namespace.strip("/")
    if prefix:
        return topic.startswith(f"/{prefix}/")
    return not namespace or not parse_namespace(topic)


def resolve_topic(topic: str, namespace: str) -> str:
    """Return the full name of a topic that may be relative to the namespace."""
    parts = [] if topic.startswith("/") else [namespace.strip("/")]
    return "/" + "/".join(filter(None, (*parts, topic.strip("/"))))


def select_cloud_topic(types: Mapping[str, str], namespace: str = "", requested: str = "") -> str:
    """Select the cloud topic: `requested`, else the one with the most columns, else the only one.

    Args:
        types: types of the published topics, by name.

    Raises:
        InputError: there is no such topic, or the choice is ambiguous.
    """
    clouds = sorted(t for t, kind in types.items() if kind == POINT_CLOUD)
    where = f" in the namespace {namespace}" if namespace else ""
    if requested:
        full_name = resolve_topic(requested, namespace)
        if full_name not in clouds:
            raise InputError(
                f"nobody publishes clouds on {full_name}; there are clouds on {', '.join(clouds) or 'no topic'}"
            )
        return full_name
    candidates = [t for t in clouds if is_in_namespace(t, namespace)]
    if not candidates:
        raise InputError(
            f"nobody publishes clouds{where}; is the graph running, on this "
            "ROS_DOMAIN_ID?" + (f" There are clouds on {', '.join(clouds)}" if clouds else "")
        )
    for end in CLOUD_ENDINGS:
        if matches := [t for t in candidates if t.endswith(f"/{end}") or t.endswith(f"_{end}")]:
            candidates = matches
            break
    if len(candidates) > 1:
        raise InputError(
            f"there are clouds on {', '.join(candidates)}; name one with --topic"
            + ("" if namespace else ", or a --namespace")
        )
    return candidates[0]


def select_box_topics(
    types: Mapping[str, str], clouds: str, namespace: str = "", requested: Iterable[str] = ()
) -> dict[str, str]:
    """Select the box topics that belong to a cloud topic; leave out copies as Detection3DArray.

    Args:
        types: types of the published topics, by name.
        requested: topics of detections; empty for all.

    Returns:
        BOXES, TRACKS or LABELS by topic.
    """
    selected = {}
    for topic, kind in types.items():
        if kind not in (MARKERS, ARRAY):
            continue
        marker_topic = topic.removesuffix(ARRAY_SUFFIX) if kind == ARRAY else topic
        if kind == ARRAY and types.get(marker_topic) == MARKERS:
            continue
        for ending, box_kind in KIND_BY_ENDING.items():
            if marker_topic.endswith(ending):
                selected[topic] = box_kind
    box_namespace = namespace or _infer_namespace(clouds, selected)
    selected = {t: k for t, k in selected.items() if is_in_namespace(t, box_namespace)}
    full_names = [resolve_topic(t, namespace) for t in requested]
    if full_names:
        selected = {t: k for t, k in selected.items() if k != BOXES}
        selected |= {t: BOXES for t in full_names if types.get(t) in (MARKERS, ARRAY)}
    return selected


def _infer_namespace(clouds: str, box_topics: Mapping[str, str]) -> str:
    """Infer the namespace of the boxes that belong to a cloud topic, as for is_in_namespace().

    Our own nodes publish both in one namespace. The topic of a driver may be named after the
    sensor, such as /ouster/points, so the nearest parent namespace with boxes is used. If there is
    only one robot with boxes, all are shown, except for NS/points, which may be another robot's.
    """
    cloud_namespace = parse_namespace(clouds)
    if "/output/" in clouds:
        return cloud_namespace or "/"
    box_namespaces = {parse_namespace(topic) for topic, kind in box_topics.items() if kind != LABELS}
    parents = [home for home in box_namespaces if not home or clouds.startswith(f"/{home}/")]
    is_single_robot = len(box_namespaces) < 2 and (parents or not cloud_namespace or not clouds.endswith(POINTS))
    return "" if is_single_robot else max(parents, key=len, default=cloud_namespace) or "/"
