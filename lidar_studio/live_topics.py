"""Selection of the topics to show of a running graph: the clouds with the most columns, and their
boxes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lidar_perception.data.to_bag import MARKERS
from lidar_perception.types import InputError
from lidar_perception.wire.clouds import POINT_CLOUD
from lidar_perception.wire.topics import FOUND, POINTS, TRUTH
from lidar_perception.wire.topics import TRACKS as TRACKED
from lidar_studio.live_graph import BOXES, LABELS, TRACKS
from lidar_studio.results import CLUSTERED_TOPICS

ARRAY = "vision_msgs/msg/Detection3DArray"
# Suffixes of cloud topics, those with the most columns first.
CLOUD_ENDINGS = tuple(topic.lstrip("/") for topic in (*CLUSTERED_TOPICS, "/ground_segmentation/output/points", POINTS))
KIND_BY_ENDING = {FOUND: BOXES, TRACKED: TRACKS, TRUTH: LABELS}
ARRAY_SUFFIX = "_3d"  # suffix of the Detection3DArray topic that accompanies a topic of markers


def parse_namespace(topic: str) -> str:
    """Return the namespace of the node that publishes a topic, from the name of the topic.

    NS for /NS/NODE/output/NAME and /NS/ground_truth/detections, else the part before the last
    slash; "" is the root.
    """
    parts = topic.removesuffix(ARRAY_SUFFIX).strip("/").split("/")
    own = 3 if parts[-2:-1] == ["output"] else 2 if parts[-2:] == TRUTH.strip("/").split("/") else 1
    return "/".join(parts[:-own])


def is_in_namespace(topic: str, namespace: str) -> bool:
    """Return True if the node of a topic is in a namespace or below it.

    The namespace "" contains all topics, "/" only those in the root.
    """
    inside = namespace.strip("/")
    if inside:
        return topic.startswith(f"/{inside}/")
    return not namespace or not parse_namespace(topic)


def resolve_topic(topic: str, namespace: str) -> str:
    """Return the full name of a topic that may be relative to the namespace."""
    parts = [] if topic.startswith("/") else [namespace.strip("/")]
    return "/" + "/".join(filter(None, (*parts, topic.strip("/"))))


def select_cloud_topic(types: Mapping[str, str], namespace: str = "", wanted: str = "") -> str:
    """Select the cloud topic: `wanted`, else the one with the most columns, else the only one.

    Args:
        types: types of the published topics, by name.

    Raises:
        InputError: there is no such topic, or the choice is ambiguous.
    """
    clouds = sorted(t for t, kind in types.items() if kind == POINT_CLOUD)
    where = f" in the namespace {namespace}" if namespace else ""
    if wanted:
        full = resolve_topic(wanted, namespace)
        if full not in clouds:
            raise InputError(
                f"nobody publishes clouds on {full}; there are clouds on {', '.join(clouds) or 'no topic'}"
            )
        return full
    inside = [t for t in clouds if is_in_namespace(t, namespace)]
    if not inside:
        raise InputError(
            f"nobody publishes clouds{where}; is the graph running, on this "
            "ROS_DOMAIN_ID?" + (f" There are clouds on {', '.join(clouds)}" if clouds else "")
        )
    for end in CLOUD_ENDINGS:
        if found := [t for t in inside if t.endswith(f"/{end}") or t.endswith(f"_{end}")]:
            inside = found
            break
    if len(inside) > 1:
        raise InputError(
            f"there are clouds on {', '.join(inside)}; name one with --topic"
            + ("" if namespace else ", or a --namespace")
        )
    return inside[0]


def select_box_topics(
    types: Mapping[str, str], clouds: str, namespace: str = "", wanted: Iterable[str] = ()
) -> dict[str, str]:
    """Select the box topics that belong to a cloud topic; leave out copies as Detection3DArray.

    Args:
        types: types of the published topics, by name.
        wanted: topics of detections; empty for all.

    Returns:
        BOXES, TRACKS or LABELS by topic.
    """
    found = {}
    for topic, kind in types.items():
        if kind not in (MARKERS, ARRAY):
            continue
        plain = topic.removesuffix(ARRAY_SUFFIX) if kind == ARRAY else topic
        if kind == ARRAY and types.get(plain) == MARKERS:
            continue
        for ending, box_kind in KIND_BY_ENDING.items():
            if plain.endswith(ending):
                found[topic] = box_kind
    home = namespace or _infer_namespace(clouds, found)
    found = {t: k for t, k in found.items() if is_in_namespace(t, home)}
    requested = [resolve_topic(t, namespace) for t in wanted]
    if requested:
        found = {t: k for t, k in found.items() if k != BOXES}
        found |= {t: BOXES for t in requested if types.get(t) in (MARKERS, ARRAY)}
    return found


def _infer_namespace(clouds: str, found: Mapping[str, str]) -> str:
    """Infer the namespace of the boxes that belong to a cloud topic, as for is_in_namespace().

    Our own nodes publish both in one namespace. The topic of a driver may be named after the
    sensor, such as /ouster/points, so the nearest parent namespace with boxes is used. If there is
    only one robot with boxes, all are shown, except for NS/points, which may be another robot's.
    """
    own = parse_namespace(clouds)
    if "/output/" in clouds:
        return own or "/"
    homes = {parse_namespace(topic) for topic, kind in found.items() if kind != LABELS}
    above = [home for home in homes if not home or clouds.startswith(f"/{home}/")]
    one_robot = len(homes) < 2 and (above or not own or not clouds.endswith(POINTS))
    return "" if one_robot else max(above, key=len, default=own) or "/"
