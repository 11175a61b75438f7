"""docs/how-to/extend.md: each example is carried out in a copy of the package, and its command
runs."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from samples import object_folder, scene

pytestmark = pytest.mark.no_cover  # others run these lines

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "how-to" / "extend.md").read_text()
PARTS = re.findall(r"`(lidar_perception/[\w/]+\.py)`:\n\n```(python|diff)\n(.*?)```", PAGE, re.S)
EXAMPLES = {"npy": 2, "sizes": 2, "lowest": 3}  # name -> files that it touches


def chosen(name: str) -> list[tuple[str, str, str]]:
    """The parts of the page that belong to an example: those from its own file to the next's."""
    own = [i for i, (_, kind, _) in enumerate(PARTS) if kind == "python"]
    first = next(i for i in own if name in PARTS[i][0])
    return PARTS[first:next((i for i in own if i > first), len(PARTS))]


@pytest.fixture
def copy(tmp_path) -> Path:
    """The package, by links: no bytes of weights are copied, and what Numba has compiled is known,
    since that goes by the time of a file."""
    for package in ("lidar_perception", "msg_utils"):
        shutil.copytree(ROOT / package, tmp_path / "copy" / package, copy_function=os.link,
                        ignore=shutil.ignore_patterns("*.pyc*", "*.tmp.*"))
    return tmp_path / "copy"


def carry_out(copy: Path, name: str) -> list[str]:
    """The paths of the files that were touched."""
    for path, kind, text in chosen(name):
        file = copy / path
        if kind == "python":
            assert not file.exists()
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)
            continue
        lines = file.read_text().splitlines()
        file.unlink()  # it is a link to the original
        after = None
        for line in text.splitlines():
            if line.startswith("-"):
                after = lines.index(line[1:])
                del lines[after]
            elif line.startswith("+"):
                if after is None:  # an import: anywhere among them
                    after = next(i for i, each in enumerate(lines) if each.startswith("from lidar"))
                lines.insert(after, line[1:])
                after = None
            else:
                after = lines.index(line[1:]) + 1
        file.write_text("\n".join(lines) + "\n")
    return [path for path, _, _ in chosen(name)]


def run(copy: Path, *arguments, folder: Path | None = None) -> str:
    """Run a command with the package at `copy`, in that or another folder."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "COLUMNS": "200"}
    done = subprocess.run([sys.executable, "-m", "lidar_perception.cli.main", *map(str, arguments)],
                          cwd=folder or copy, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize("name, files", EXAMPLES.items())
def test_the_page_says_how_many_files_an_example_touches(name, files):
    assert len(chosen(name)) == files


def test_a_data_set_is_one_file_and_one_entry(copy, tmp_path):
    carry_out(copy, "npy")
    (tmp_path / "clouds").mkdir()
    for i in range(2):
        np.save(tmp_path / "clouds" / f"{i}.npy", scene(i))
    np.save(tmp_path / "clouds" / "0.boxes.npy", [[8, 0.5, -0.85, 0.5, 0.5, 1.7, 0.3]])
    said = run(copy, "convert", tmp_path / "clouds", "--out", tmp_path / "bag")
    assert "folder of .npy clouds, 2 frames" in said and "2 scans of 2" in said


def test_detector_is_a_class_in_your_own_file(tmp_path):
    source, = re.findall(r"`my_detector.py`:\n\n```python\n(.*?)```", PAGE, re.S)
    (tmp_path / "my_detector.py").write_text(source)
    said = run(ROOT, "evaluate", "detection", "--data", object_folder(tmp_path / "kitti"),
               "--weights", "my_detector:TallClusters", folder=tmp_path)
    assert "2 frames" in said and "Ped" in said
    run(ROOT, "detect", tmp_path / "kitti", "--weights", "my_detector:TallClusters", "--out",
        tmp_path / "results", folder=tmp_path)
    assert "Pedestrian" in (tmp_path / "results" / "detections.json").read_text()


def test_a_detector_is_one_folder_and_one_entry(copy, tmp_path):
    carry_out(copy, "sizes")
    said = run(copy, "evaluate", "detection", "--data", object_folder(tmp_path / "kitti"),
               "--weights", "sizes")
    assert "2 frames" in said


def test_a_ground_method_is_one_file_and_two_entries(copy, tmp_path):
    carry_out(copy, "lowest")
    said = run(copy, "evaluate", "segmentation", "--data", object_folder(tmp_path / "kitti"),
               "--methods", "dbscan", "--set", "ground.method=lowest")
    assert "ground by lowest" in said


def test_a_class_is_one_row_that_all_networks_of_the_package_go_on_with(copy, tmp_path):
    file = copy / "lidar_perception" / "classes.py"
    known, row = file.read_text(), '    ObjectClass("Truck", vehicle=True),\n'
    assert row in known
    file.unlink()  # it is a link to the original
    numbers = "DetectionNumbers((8.0, 2.5, 3.2), 0.6, 0.45, (8.0, 2.5, 3.2), 5.0, 0.7, 0.5)"
    file.write_text(known.replace(row, row.replace("vehicle", f"{numbers}, vehicle")))
    said = run(copy, "evaluate", "detection", "--data", object_folder(tmp_path / "kitti"))
    assert "2 frames" in said and "Truck" in said
    assert re.search(r"\n +Car E +Car M +Car H +Cyc E", said)  # the paper's columns
