"""Which topics of a running graph are looked at: the clouds that say most, and the boxes that go
with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lidar_perception.data.to_bag import MARKERS
from lidar_perception.types import InputError
from lidar_perception.wire.clouds import POINT_CLOUD
from lidar_perception.wire.topics import FOUND, POINTS, TRUTH
from lidar_perception.wire.topics import TRACKS as TRACKED
from lidar_studio.live import BOXES, LABELS, TRACKS
from lidar_studio.results import CLUSTERED

ARRAY = "vision_msgs/msg/Detection3DArray"
# The ends of topics of clouds, those with the most columns first.
CLOUDS = tuple(topic.lstrip("/") for topic in (
    *CLUSTERED, "/ground_segmentation/output/points", POINTS))
ENDS = {FOUND: BOXES, TRACKED: TRACKS, TRUTH: LABELS}
TWIN = "_3d"  # what a topic of markers is called as a Detection3DArray


def namespace_of(topic: str) -> str:
    """Where the node of a topic is, by its name: NS of /NS/NODE/output/NAME and of
    /NS/ground_truth/detections, of others what is before the last slash; "" is the root."""
    parts = topic.removesuffix(TWIN).strip("/").split("/")
    own = 3 if parts[-2:-1] == ["output"] else 2 if parts[-2:] == TRUTH.strip("/").split("/") else 1
    return "/".join(parts[:-own])


def in_namespace(topic: str, namespace: str) -> bool:
    """Whether a topic is of a node in a namespace: "" for all, "/" for the root alone, else with
    those inside it."""
    inside = namespace.strip("/")
    if inside:
        return topic.startswith(f"/{inside}/")
    return not namespace or not namespace_of(topic)


def resolved(topic: str, namespace: str) -> str:
    """The whole name of a topic that was given as it is, or relative to the namespace."""
    parts = [] if topic.startswith("/") else [namespace.strip("/")]
    return "/" + "/".join(filter(None, (*parts, topic.strip("/"))))


def clouds_topic(types: Mapping[str, str], namespace: str = "", wanted: str = "") -> str:
    """The topic of the clouds, of topic -> type of all that is published: the wanted one; else the
    one with most columns, else the only one. InputError, in a line for a person, where there is
    none, or it is not clear which."""
    clouds = sorted(t for t, kind in types.items() if kind == POINT_CLOUD)
    where = f" in the namespace {namespace}" if namespace else ""
    if wanted:
        full = resolved(wanted, namespace)
        if full not in clouds:
            raise InputError(f"nobody publishes clouds on {full}; there are clouds on "
                             f"{', '.join(clouds) or 'no topic'}")
        return full
    inside = [t for t in clouds if in_namespace(t, namespace)]
    if not inside:
        raise InputError(f"nobody publishes clouds{where}; is the graph running, on this "
                         "ROS_DOMAIN_ID?" + (f" There are clouds on {', '.join(clouds)}"
                                             if clouds else ""))
    for end in CLOUDS:
        if found := [t for t in inside if t.endswith(f"/{end}") or t.endswith(f"_{end}")]:
            inside = found
            break
    if len(inside) > 1:
        raise InputError(f"there are clouds on {', '.join(inside)}; name one with --topic"
                         + ("" if namespace else ", or a --namespace"))
    return inside[0]


def box_topics(types: Mapping[str, str], clouds: str, namespace: str = "",
               wanted: Iterable[str] = ()) -> dict[str, str]:
    """Topic -> kind (BOXES, TRACKS, LABELS) of what goes with the clouds of a topic, see _home().
    wanted: the topics of detections, instead of all that there are. An array that is there as
    markers too is left out."""
    found = {}
    for topic, kind in types.items():
        if kind not in (MARKERS, ARRAY):
            continue
        plain = topic.removesuffix(TWIN) if kind == ARRAY else topic
        if kind == ARRAY and types.get(plain) == MARKERS:
            continue
        for ending, what in ENDS.items():
            if plain.endswith(ending):
                found[topic] = what
    home = namespace or _home(clouds, found)
    found = {t: k for t, k in found.items() if in_namespace(t, home)}
    asked = [resolved(t, namespace) for t in wanted]
    if asked:
        found = {t: k for t, k in found.items() if k != BOXES}
        found |= {t: BOXES for t in asked if types.get(t) in (MARKERS, ARRAY)}
    return found


def _home(clouds: str, found: Mapping[str, str]) -> str:
    """The namespace, for in_namespace(), of what goes with clouds, where none was given: of a
    node's clouds that of the node. A driver's may be named after the sensor, as /ouster/points, so
    with them goes the nearest one above that has boxes; and all there is where that is of one
    robot, except with NS/points, which may be of another."""
    own = namespace_of(clouds)
    if "/output/" in clouds:
        return own or "/"
    homes = {namespace_of(topic) for topic, kind in found.items() if kind != LABELS}
    above = [home for home in homes if not home or clouds.startswith(f"/{home}/")]
    one_robot = len(homes) < 2 and (above or not own or not clouds.endswith(POINTS))
    return "" if one_robot else max(above, key=len, default=own) or "/"
