"""The `label` and `view` commands of lidar-perception."""

from importlib.util import find_spec

from lidar_perception.types import InputError

if find_spec("aiohttp") is None:
    raise InputError("label and view require aiohttp; run pip install 'lidar_perception[studio]'")
