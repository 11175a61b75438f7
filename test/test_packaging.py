"""Metadata of setup.py for pip, colcon and a package index."""

from __future__ import annotations

import os
import re
from pathlib import Path
from runpy import run_path
from xml.etree import ElementTree

import pytest
import setuptools

import lidar_perception
from lidar_perception.nodes import NODES

ROOT = Path(__file__).resolve().parents[1]
URL = "https://example.org/robots/lidar_perception"

pytestmark = pytest.mark.skipif(not (ROOT / "setup.py").exists(), reason="needs the checkout")


@pytest.fixture
def metadata(monkeypatch):
    """Return a function that returns the arguments of setup() for a repository URL."""

    def read(url):
        arguments = {}
        monkeypatch.chdir(ROOT)
        monkeypatch.setenv("LIDAR_REPOSITORY_URL", url)
        monkeypatch.setattr(setuptools, "setup", arguments.update)
        run_path(str(ROOT / "setup.py"))
        return arguments

    return read


def test_version_is_the_same_everywhere(metadata):
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert metadata(URL)["version"] == lidar_perception.__version__ == package.findtext("version")


def test_readme_of_the_wheel_has_no_relative_links(metadata):
    links = re.findall(r"\]\(([^)]*)\)", metadata(URL + ".git")["long_description"])
    assert len(links) > 5
    assert [link for link in links if not link.startswith(("https://", "#"))] == []
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", metadata(URL)["long_description"])
    assert all(link.startswith(f"{URL}/raw/main/") for link in pictures)
    assert all((ROOT / link.removeprefix(f"{URL}/raw/main/")).is_file() for link in pictures)


def test_project_urls_follow_the_repository(metadata):
    arguments = metadata(URL)
    assert arguments["url"] == URL
    assert set(arguments["project_urls"]) >= {"Source", "Issues", "Changelog"}
    assert all(page.startswith(URL) for page in arguments["project_urls"].values())


def test_both_packages_ship_type_information(metadata):
    for name in ("lidar_perception", "msg_utils"):
        assert "py.typed" in metadata(URL)["package_data"][name]
        assert (ROOT / name / "py.typed").is_file()


def test_release_moves_unreleased_changes_under_the_version():
    release = run_path(str(ROOT / "scripts/release.py"))
    text = "# Changes\n\n## Unreleased\n\n### Added\n\n### Fixed\n\n- A bug.\n\n## 0.1.0\n\n- Old.\n"
    dated = release["date_changelog"](text, "0.2.0", "2026-12-01")
    assert dated == (
        "# Changes\n\n" + release["EMPTY"] + "## 0.2.0 - 2026-12-01\n\n### Fixed\n\n- A bug.\n\n## 0.1.0\n\n- Old.\n"
    )
    with pytest.raises(SystemExit, match="no unreleased change"):
        release["date_changelog"](text.replace("- A bug.\n", ""), "0.2.0", "2026-12-01")


def test_release_sets_the_version_in_both_files(tmp_path):
    release = run_path(str(ROOT / "scripts/release.py"))
    for name in ("lidar_perception/__init__.py", "package.xml"):
        copy = tmp_path / name
        copy.parent.mkdir(exist_ok=True)
        copy.write_text((ROOT / name).read_text())
    release["set_version"](tmp_path, "7.8.9")
    assert '__version__ = "7.8.9"' in (tmp_path / "lidar_perception/__init__.py").read_text()
    assert "<version>7.8.9</version>" in (tmp_path / "package.xml").read_text()


def test_citation_file_lists_the_three_papers():
    import yaml

    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert len(cited["references"]) == 3
    assert all(paper["doi"].startswith("10.") for paper in cited["references"])


def test_each_node_has_one_executable_in_lib(metadata):
    """They are not in bin, so that names such as `tracker` are not on the PATH of users."""
    arguments = metadata(URL)
    files = dict(arguments["data_files"])["lib/lidar_perception"]
    assert sorted(Path(file).name for file in files) == sorted(NODES)
    assert all(os.access(ROOT / file, os.X_OK) for file in files)
    assert [line.split()[0] for line in arguments["entry_points"]["console_scripts"]] == ["lidar-perception"]


def test_wheel_ships_the_weights_of_the_default_detector_and_v4(metadata):
    package = ROOT / "lidar_perception"
    shipped = {
        path.name
        for pattern in metadata(URL)["package_data"]["lidar_perception"]
        for path in package.glob(pattern)
        if path.suffix == ".safetensors"
    }
    assert shipped == {
        "judge.safetensors",
        "pointnet.safetensors",
        "pointpillars_v4_compact.safetensors",
        "pointpillars_v4_compact_nine_sensors.safetensors",
        "pointpillars_v4_full.safetensors",
    }
