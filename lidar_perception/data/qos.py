"""QoS profiles of topics in bags."""

from __future__ import annotations

from typing import Any, cast

import yaml
from rosbags.interfaces import Qos
from rosbags.rosbag2.metadata import parse_qos

# Keys and values of rosbag2. Late subscribers get the last message of a latched topic.
SENSOR_QOS = dict(history="keep_last", depth=10, reliability="reliable", durability="volatile")
LATCHED_QOS = dict(history="keep_last", depth=1, reliability="reliable",
                   durability="transient_local")

_INFINITE = {"sec": 9223372036, "nsec": 854775807}
_OTHER_POLICIES = {"deadline": _INFINITE, "lifespan": _INFINITE, "liveliness": "automatic",
                   "liveliness_lease_duration": _INFINITE, "avoid_ros_namespace_conventions": False}


def complete_profile(qos: dict[str, Any]) -> dict[str, Any]:
    """Return a profile such as SENSOR_QOS with all policies that rosbag2 writes."""
    return {**qos, **_OTHER_POLICIES}


def parse_profiles(given: Any) -> list[Qos]:
    """Return the profiles of a topic, given as YAML text or parsed; [] if they cannot be parsed.

    Only history, depth, reliability and durability are read. Writers represent durations in many
    ways (numbers, "infinite", left out), and nodes do not need them.
    """
    try:
        profiles = yaml.safe_load(given) if isinstance(given, str) else given
        # rosbags requires all policies (rosbags/rosbag2/metadata.py, parse_qos).
        return parse_qos(cast(Any, [
            {**SENSOR_QOS, **{key: profile[key] for key in SENSOR_QOS
                              if isinstance(profile.get(key), str | int)}, **_OTHER_POLICIES}
            for profile in profiles or ()]))
    except (yaml.YAMLError, AttributeError, TypeError, ValueError):
        return []
