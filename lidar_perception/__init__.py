"""LiDAR perception on NumPy arrays, with thin ROS 2 nodes around it.

    import lidar_perception as lp

    detector = lp.load_detector(range="around")
    for frame in lp.open_recording("drive.bag"):
        print(detector(frame.load()).detections.boxes)

The names in `__all__` are the public interface. They are imported when they are first used.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidar_perception.api import cluster, evaluate, find_candidates, load_detector, segment_ground, simulate
    from lidar_perception.data.open import open_recording
    from lidar_perception.tracking.state import Tracks
    from lidar_perception.tracking.tracker import Tracker
    from lidar_perception.types import Detections, PointCloud

__version__ = "0.1.0"
__all__ = [
    "Detections",
    "PointCloud",
    "Tracker",
    "Tracks",
    "cluster",
    "evaluate",
    "find_candidates",
    "load_detector",
    "open_recording",
    "segment_ground",
    "simulate",
]

_OTHER_MODULES = {  # (module, name) of everything outside lidar_perception.api
    "Detections": ("types", "Detections"),
    "PointCloud": ("types", "PointCloud"),
    "Tracker": ("tracking.tracker", "Tracker"),
    "Tracks": ("tracking.state", "Tracks"),
    "open_recording": ("data.open", "open_recording"),
}


if not TYPE_CHECKING:  # otherwise every name would exist for a type checker

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        module, attribute = _OTHER_MODULES.get(name, ("api", name))
        return getattr(importlib.import_module(f"{__name__}.{module}"), attribute)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
