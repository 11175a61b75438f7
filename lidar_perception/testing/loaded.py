"""Loads what nodes need, for processes that are forked from the one that imports this."""

import os
from contextlib import suppress
from importlib import import_module

from lidar_perception.nodes import NODES
from lidar_perception.runs.threads import wait_asleep

# As in nodes.main: these are read when libraries are loaded.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
wait_asleep()
for module in (*(f"nodes.{name}" for name in NODES), "nodes.stopping", "detectors.open"):
    with suppress(ImportError):  # the node says it
        import_module(f"lidar_perception.{module}")
with suppress(ImportError):
    from lidar_perception.candidates.warm_up import warm_up
    warm_up()
