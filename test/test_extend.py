"""Examples of docs/how-to/extend.md, applied to a copy of the package and run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from samples import make_scene, write_object_folder

pytestmark = pytest.mark.no_cover  # covered by other tests

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "how-to" / "extend.md").read_text()
PARTS = re.findall(r"`(lidar_perception/[\w/]+\.py)`:\n\n```(python|diff)\n(.*?)```", PAGE, re.S)
EXAMPLES = {"npy": 2, "sizes": 2, "lowest": 3}  # number of changed files by name


def find_parts(name: str) -> list[tuple[str, str, str]]:
    """Return the parts of an example, from its new file to that of the next example."""
    own = [i for i, (_, kind, _) in enumerate(PARTS) if kind == "python"]
    first = next(i for i in own if name in PARTS[i][0])
    return PARTS[first : next((i for i in own if i > first), len(PARTS))]


@pytest.fixture
def package_copy(tmp_path) -> Path:
    """Copy the package as hard links, so that no weights are copied and Numba's cache is valid."""
    for package in ("lidar_perception", "msg_utils"):
        shutil.copytree(
            ROOT / package,
            tmp_path / "copy" / package,
            copy_function=os.link,
            ignore=shutil.ignore_patterns("*.pyc*", "*.tmp.*"),
        )
    return tmp_path / "copy"


def apply_example(copy: Path, name: str) -> list[str]:
    """Apply the changes of an example; return the paths of the changed files."""
    for path, kind, text in find_parts(name):
        file = copy / path
        if kind == "python":
            assert not file.exists()
            file.parent.mkdir(exist_ok=True)
            file.write_text(text)
            continue
        lines = file.read_text().splitlines()
        file.unlink()  # a hard link to the original
        after = None
        for line in text.splitlines():
            if line.startswith("-"):
                after = lines.index(line[1:])
                del lines[after]
            elif line.startswith("+"):
                if after is None:  # an import line may be inserted anywhere among the imports
                    after = next(i for i, old in enumerate(lines) if old.startswith("from lidar"))
                lines.insert(after, line[1:])
                after = None
            else:
                after = lines.index(line[1:]) + 1
        file.write_text("\n".join(lines) + "\n")
    return [path for path, _, _ in find_parts(name)]


def run_copy(copy: Path, *arguments, folder: Path | None = None) -> str:
    """Run a command with the package at `copy` and return its output."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "COLUMNS": "200"}
    done = subprocess.run(
        [sys.executable, "-m", "lidar_perception.cli.main", *map(str, arguments)],
        cwd=folder or copy,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize("name, files", EXAMPLES.items())
def test_example_changes_the_stated_number_of_files(name, files):
    assert len(find_parts(name)) == files


def test_data_format_needs_one_file_and_one_entry(package_copy, tmp_path):
    apply_example(package_copy, "npy")
    (tmp_path / "clouds").mkdir()
    for i in range(2):
        np.save(tmp_path / "clouds" / f"{i}.npy", make_scene(i))
    np.save(tmp_path / "clouds" / "0.boxes.npy", [[8, 0.5, -0.85, 0.5, 0.5, 1.7, 0.3]])
    output = run_copy(package_copy, "convert", tmp_path / "clouds", "--out", tmp_path / "bag")
    assert "folder of .npy clouds, 2 frames" in output and "2 scans of 2" in output


def test_detector_is_a_class_in_your_own_file(tmp_path):
    (source,) = re.findall(r"`my_detector.py`:\n\n```python\n(.*?)```", PAGE, re.S)
    (tmp_path / "my_detector.py").write_text(source)
    output = run_copy(
        ROOT,
        "evaluate",
        "detection",
        "--data",
        write_object_folder(tmp_path / "kitti"),
        "--weights",
        "my_detector:TallClusters",
        folder=tmp_path,
    )
    assert "2 frames" in output and "Ped" in output
    run_copy(
        ROOT,
        "detect",
        tmp_path / "kitti",
        "--weights",
        "my_detector:TallClusters",
        "--out",
        tmp_path / "results",
        folder=tmp_path,
    )
    assert "Pedestrian" in (tmp_path / "results" / "detections.json").read_text()


def test_detector_needs_one_folder_and_one_entry(package_copy, tmp_path):
    apply_example(package_copy, "sizes")
    output = run_copy(
        package_copy, "evaluate", "detection", "--data", write_object_folder(tmp_path / "kitti"), "--weights", "sizes"
    )
    assert "2 frames" in output


def test_ground_method_needs_one_file_and_two_entries(package_copy, tmp_path):
    apply_example(package_copy, "lowest")
    output = run_copy(
        package_copy,
        "evaluate",
        "segmentation",
        "--data",
        write_object_folder(tmp_path / "kitti"),
        "--methods",
        "dbscan",
        "--set",
        "ground.method=lowest",
    )
    assert "ground by lowest" in output


def test_class_needs_one_row_and_shipped_networks_still_work(package_copy, tmp_path):
    file = package_copy / "lidar_perception" / "classes.py"
    known, row = file.read_text(), '    ObjectClass("Truck", vehicle=True),\n'
    assert row in known
    file.unlink()  # a hard link to the original
    numbers = "DetectionConstants((8.0, 2.5, 3.2), 0.6, 0.45, (8.0, 2.5, 3.2), 5.0, 0.7, 0.5)"
    file.write_text(known.replace(row, row.replace("vehicle", f"{numbers}, vehicle")))
    output = run_copy(package_copy, "evaluate", "detection", "--data", write_object_folder(tmp_path / "kitti"))
    assert "2 frames" in output and "Truck" in output
