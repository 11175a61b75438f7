"""Names of label formats and their aliases."""

from __future__ import annotations

from collections.abc import Iterable

from lidar_perception.types import make_unknown_name_error

ALIASES = {"kitti-object": "kitti", "bag": "mcap", "bag-labels": "mcap-labels"}


def resolve_format(name: str, names: Iterable[str]) -> str:
    """Return the name of a format as it is spelt in `names`.

    Case and the choice between hyphens and underscores do not matter.

    Raises:
        InputError: The format is not in `names`.
    """
    format_name = name.strip().lower().replace("_", "-")
    format_name, names = ALIASES.get(format_name, format_name), list(names)
    if format_name not in names:
        raise make_unknown_name_error("format", name, names)
    return format_name
