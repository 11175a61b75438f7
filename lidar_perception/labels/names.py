"""Names of formats and their aliases."""

from __future__ import annotations

from collections.abc import Iterable

from lidar_perception.types import unknown_name

ALIASES = {"kitti-object": "kitti", "bag": "mcap", "bag-labels": "mcap-labels"}


def resolve_format(name: str, known: Iterable[str]) -> str:
    """Return the name of a format as spelt in `known`; case, hyphens and underscores do not matter.

    Raises:
        InputError: `known` has no such name.
    """
    normalised = name.strip().lower().replace("_", "-")
    normalised, known = ALIASES.get(normalised, normalised), list(known)
    if normalised not in known:
        raise unknown_name("format", name, known)
    return normalised
