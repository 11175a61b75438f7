"""Benchmarks of our algorithms against others: python -m benchmark, or ./lidar benchmark."""

from lidar_perception.runs.threads import use_passive_waiting

use_passive_waiting()  # before __main__ loads torch, as OpenMP reads its environment once
