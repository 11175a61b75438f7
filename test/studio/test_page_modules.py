"""The modules of the page import each other in one direction, and the bundle is up to date."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[2] / "page" / "src"
BUNDLE = Path(__file__).parents[2] / "lidar_studio" / "page"


def find_cycle(imports: dict[str, set[str]]) -> list[str]:
    """Return the modules that import each other, sorted; empty if there are none."""
    remaining = dict(imports)
    while free := [name for name, used in remaining.items() if not used & remaining.keys()]:
        for name in free:
            del remaining[name]
    return sorted(remaining)


def test_page_modules_import_in_one_direction():
    imports = {
        path.stem: set(re.findall(r'(?:from|import) "\./(\w+)\.js"', path.read_text())) for path in SOURCES.glob("*.js")
    }
    assert imports["api"] and imports.keys() >= set().union(*imports.values())
    assert find_cycle(imports) == []


def test_cycle_of_imports_is_found():
    assert find_cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == ["a", "b", "c"]


@pytest.mark.parametrize("name", ["edits.js", "topbar.js", "live.js", "resultpanel.js"])
def test_bundle_has_the_messages_of_the_sources(name):
    bundle = (BUNDLE / "app.js").read_text()
    texts = re.findall(r'"([A-Z][\w ,.+;:\']{20,})"', (SOURCES / name).read_text())
    assert [text for text in texts if text not in bundle] == []


def test_bundle_has_the_page_of_the_sources():
    assert (BUNDLE / "index.html").read_text() == (SOURCES / "index.html").read_text()
