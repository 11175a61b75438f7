"""The `label` and `view` verbs of the lidar-perception command."""

from importlib.util import find_spec

from lidar_perception.types import InputError

if find_spec("aiohttp") is None:
    raise InputError("label and view need aiohttp; pip install 'lidar_perception[studio]'")
