"""Names of label formats and their aliases."""

from __future__ import annotations

from collections.abc import Iterable

from lidar_perception.types import unknown_name

ALIASES = {"kitti-object": "kitti", "bag": "mcap", "bag-labels": "mcap-labels"}


def resolve_format(name: str, names: Iterable[str]) -> str:
    """Return the name of a format as it is spelt in `names`.

    Case does not matter, nor does the choice between hyphens and underscores.

    Raises:
        InputError: `names` has no such format.
    """
    normalised = name.strip().lower().replace("_", "-")
    normalised, names = ALIASES.get(normalised, normalised), list(names)
    if normalised not in names:
        raise unknown_name("format", name, names)
    return normalised
