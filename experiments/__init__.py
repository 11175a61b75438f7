"""Experiments on lidar_perception, run from a checkout. The wheel does not contain them."""
