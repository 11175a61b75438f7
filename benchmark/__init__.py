"""Benchmarks of our algorithms against other implementations: python -m benchmark, or ./lidar benchmark."""

from lidar_perception.runs.threads import use_passive_waiting

use_passive_waiting()  # must precede the import of torch, because OpenMP reads its environment once
