"""Sources of the packages and of the tests, for rules that apply to all of them."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = "lidar_perception", "lidar_studio", "msg_utils"


def _list_sources(*folders: str) -> list[str]:
    return [p.relative_to(ROOT).as_posix() for folder in folders for p in sorted((ROOT / folder).rglob("*.py"))]


SOURCES = _list_sources(*PACKAGES)
TESTS = _list_sources("test")


@cache
def parse_source(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_text(encoding="utf-8"), name)


def list_files(*folders: str) -> list[str]:
    return [name for name in SOURCES if any(name.startswith(f"{folder}/") for folder in folders)]
