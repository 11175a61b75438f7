"""The names of formats: one spelling, others accepted."""

from __future__ import annotations

from collections.abc import Iterable

from lidar_perception.types import unknown_name

ALIASES = {"kitti-object": "kitti", "bag": "mcap", "bag-labels": "mcap-labels"}


def format_name(name: str, known: Iterable[str]) -> str:
    """Return the name of a format as it is in `known`, in any case, with hyphens or underscores.

    Raises:
        InputError: `known` has no such name.
    """
    plain = name.strip().lower().replace("_", "-")
    plain, known = ALIASES.get(plain, plain), list(known)
    if plain not in known:
        raise unknown_name("format", name, known)
    return plain
