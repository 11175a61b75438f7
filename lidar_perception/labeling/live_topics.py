"""Which topics of a running graph are looked at: the clouds that say most, and the boxes that go
with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lidar_perception.data.bag_frames import CLOUD
from lidar_perception.labeling.live import BOXES, LABELS, TRACKS
from lidar_perception.labeling.results import CLUSTERED, FOUND, MARKERS
from lidar_perception.labeling.results import TRACKS as TRACKED
from lidar_perception.types import InputError
from lidar_perception.wire.topics import POINTS, TRUTH

ARRAY = "vision_msgs/msg/Detection3DArray"
# The ends of topics of clouds, those with the most columns first.
CLOUDS = tuple(topic.lstrip("/") for topic in (
    *CLUSTERED, "/ground_segmentation/output/points", POINTS))
ENDS = {FOUND: BOXES, TRACKED: TRACKS, TRUTH: LABELS}
TWIN = "_3d"  # what a topic of markers is called as a Detection3DArray


def in_namespace(topic: str, namespace: str) -> bool:
    """Whether a topic is in a namespace, "" or "/" for all."""
    inside = namespace.strip("/")
    return not inside or topic.startswith(f"/{inside}/")


def resolved(topic: str, namespace: str) -> str:
    """The whole name of a topic that was given as it is, or relative to the namespace."""
    parts = [] if topic.startswith("/") else [namespace.strip("/")]
    return "/" + "/".join(filter(None, (*parts, topic.strip("/"))))


def clouds_topic(types: Mapping[str, str], namespace: str = "", wanted: str = "") -> str:
    """The topic of the clouds, of topic -> type of all that is published: the wanted one; else the
    one with most columns, else the only one. InputError, in a line for a person, where there is
    none, or it is not clear which."""
    clouds = sorted(t for t, kind in types.items() if kind == CLOUD)
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
    """Topic -> kind (BOXES, TRACKS, LABELS) of what goes with the clouds of a topic: what is in its
    namespace. wanted: the topics of detections, instead of all that there are. An array that is
    there as markers too is left out."""
    end = next((e for e in CLOUDS if clouds.endswith(f"/{e}")), "")
    inside = namespace or clouds.removesuffix(end).strip("/") if end else namespace
    found = {}
    for topic, kind in types.items():
        if kind not in (MARKERS, ARRAY) or not in_namespace(topic, inside):
            continue
        plain = topic.removesuffix(TWIN) if kind == ARRAY else topic
        if kind == ARRAY and types.get(plain) == MARKERS:
            continue
        for ending, what in ENDS.items():
            if plain.endswith(ending):
                found[topic] = what
    asked = [resolved(t, namespace) for t in wanted]
    if asked:
        found = {t: k for t, k in found.items() if k != BOXES}
        found |= {t: BOXES for t in asked if types.get(t) in (MARKERS, ARRAY)}
    return found
