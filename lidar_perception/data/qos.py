"""Quality of service in bags: as rosbag2 writes it, and as any version or person wrote it."""

from __future__ import annotations

from typing import Any, cast

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

# In rosbag2's words. Late subscribers get the last message of a latched topic.
SENSOR_QOS = dict(history="keep_last", depth=10, reliability="reliable", durability="volatile")
LATCHED_QOS = dict(history="keep_last", depth=1, reliability="reliable",
                   durability="transient_local")

_FOREVER = {"sec": 9223372036, "nsec": 854775807}
_REST = {"deadline": _FOREVER, "lifespan": _FOREVER, "liveliness": "automatic",
         "liveliness_lease_duration": _FOREVER, "avoid_ros_namespace_conventions": False}


def full_profile(qos: dict[str, Any]) -> dict[str, Any]:
    """Return a profile such as SENSOR_QOS with all that rosbag2 writes of one."""
    return {**qos, **_REST}


def read_profiles(given: Any) -> list[Qos]:
    """Return the profiles of a topic, given as YAML text or parsed; [] where they are not readable.

    Nodes need history, depth, reliability and durability. Durations are written in many ways
    (numbers, "infinite", left out), and are not read.
    """
    try:
        profiles = yaml.safe_load(given) if isinstance(given, str) else given
        # rosbags needs all of them to be there (rosbags/rosbag2/metadata.py, parse_qos).
        return parse_qos(cast(Any, [
            {**SENSOR_QOS, **{key: profile[key] for key in SENSOR_QOS
                              if isinstance(profile.get(key), str | int)}, **_REST}
            for profile in profiles or ()]))
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        return []
