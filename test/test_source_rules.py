"""Rules for all sources: names, docstrings, length, and constants."""

from __future__ import annotations

import ast
from configparser import ConfigParser
from pathlib import Path

import pytest
from samples import for_all
from sources import ROOT, SOURCES, TESTS, list_files, parse_source

pytestmark = pytest.mark.no_cover
NAMING_CLASSES = (
    "lidar_perception/classes.py",
    "lidar_perception/data/",  # the names of formats
    "lidar_perception/simulation/shapes/",  # a shape per class
    "lidar_perception/detectors/pointpillars/import_weights.py",
)


@for_all([n for n in SOURCES if n.startswith("lidar_perception/") and not n.startswith(NAMING_CLASSES)])
def test_class_names_are_only_in_their_table(name):
    from lidar_perception.classes import CLASSES

    written = {
        node.value
        for node in ast.walk(parse_source(name))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    assert written & set(CLASSES) - {"DontCare", "Misc"} == set()


def test_mypy_ignores_no_module():
    settings = ConfigParser()
    settings.read(ROOT / "setup.cfg")
    sections = {name: dict(settings[name]) for name in settings if name.startswith("mypy")}
    assert sections["mypy"]["files"] == (
        "lidar_perception, lidar_studio, msg_utils, scripts, benchmark, experiments, examples"
    )
    assert {
        name for name, options in sections.items() if {"ignore_errors", "exclude", "follow_imports"} & set(options)
    } == {"mypy-launch"}
    assert [name for name in SOURCES if "# mypy:" in (ROOT / name).read_text()] == []


@for_all(SOURCES)
def test_modules_have_docstrings_and_specific_names(name):
    assert ast.get_docstring(parse_source(name)), "no docstring"
    parts = Path(name).with_suffix("").parts
    assert not {"utils", "util", "helpers", "common", "misc"} & set(parts)


@for_all([*SOURCES, *TESTS])
def test_source_files_have_at_most_400_lines(name):
    assert len((ROOT / name).read_text(encoding="utf-8").splitlines()) <= 400


@for_all(TESTS)
def test_names_of_tests_have_at_most_60_characters(name):
    functions = (node.name for node in ast.walk(parse_source(name)) if isinstance(node, ast.FunctionDef))
    assert [function for function in functions if function.startswith("test_") and len(function) > 60] == []


def test_constants_of_clustering_have_unique_names():
    """Modules import constants from each other, so equal names would be ambiguous."""
    files_by_name = {}
    for name in list_files("lidar_perception/clustering"):
        for node in parse_source(name).body:
            if isinstance(node, ast.Assign) and isinstance(node.value, (ast.Constant, ast.BinOp)):
                for target in node.targets:
                    files_by_name.setdefault(ast.unparse(target), []).append(name)
    assert len(files_by_name) > 10 and {n: w for n, w in files_by_name.items() if len(w) > 1} == {}


def test_test_files_do_not_import_each_other():
    """Shared code is in test/support or in a conftest.py."""
    for path in sorted((ROOT / "test").rglob("*.py")):
        imported = {
            name.split(".")[-1]
            for node in ast.walk(ast.parse(path.read_text()))
            for name in (
                [node.module or ""]
                if isinstance(node, ast.ImportFrom)
                else [a.name for a in node.names]
                if isinstance(node, ast.Import)
                else []
            )
        }
        assert not [name for name in imported if name.startswith("test_")], path
