"""Module that loads the modules that nodes need, in the process from which nodes are forked."""

from contextlib import suppress
from importlib import import_module

from lidar_perception.nodes import NODES, load_node_class
from lidar_perception.runs.threads import default_to_one_thread

default_to_one_thread()  # as nodes.main does
for name in NODES:
    with suppress(ImportError):  # the node reports it when it starts
        load_node_class(name)
for module in ("nodes.stopping", "detectors.open"):
    with suppress(ImportError):
        import_module(f"lidar_perception.{module}")
with suppress(ImportError):
    from lidar_perception.candidates.warm_up import warm_up

    warm_up()
