"""The scripts and the notebook of examples/ are short and run."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from samples import make_scene, write_object_folder

import lidar_perception as lp

pytestmark = pytest.mark.no_cover  # covered by other tests
EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
NOTEBOOK = EXAMPLES / "first_steps.ipynb"
SENSOR = "generic:16,-20,5,1,10"


def get_code(notebook: Path) -> list[str]:
    """Return the source of each code cell."""
    cells = json.loads(notebook.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]


def test_examples_are_short_and_use_the_public_interface():
    sources = [path.read_text() for path in SCRIPTS] + ["\n".join(get_code(NOTEBOOK))]
    assert len(SCRIPTS) == 6
    for source in sources:
        assert "import lidar_perception as lp" in source and "lidar_perception." not in source
        assert source.count("\n") < 40


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Return a function that runs an example in an empty folder, with short simulated drives, and
    returns its output."""
    simulate = lp.simulate

    def simulate_briefly(frames=40, *args, **options):
        return simulate(min(frames, 2), *args, **{**options, "sensor": SENSOR})

    def run_script(name: str, *arguments: object) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(lp, "simulate", simulate_briefly, raising=False)
        monkeypatch.setattr("sys.argv", [name, *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        return capsys.readouterr().out

    return run_script


@pytest.mark.parametrize(
    "name, words",
    [
        ("detect.py", "0000/000001: "),
        ("own_detector.py", "AP on 2 frames"),
        ("ground_and_clusters.py", "points are ground"),
        ("track.py", "tracks"),
        ("evaluate.py", "fused on 2 frames"),
    ],
)
def test_example_runs_on_simulated_scans(run, name, words):
    assert words in run(name)


def test_example_accepts_a_recording(run, tmp_path):
    np.save(tmp_path / "cloud.npy", make_scene(0))
    assert "patchwork: " in run("ground_and_clusters.py", tmp_path / "cloud.npy")
    output = run("evaluate.py", write_object_folder(tmp_path / "kitti"), "pointnet")
    assert "pointnet on 2 frames" in output and "Pedestrian" in output


def test_example_writes_simulated_clouds(run, tmp_path):
    assert "2 frames" in run("simulate_to_files.py", tmp_path / "out")
    boxes = json.loads(next((tmp_path / "out" / "labels").iterdir()).read_text())
    assert all(len(each["box"]) == 7 for each in boxes)


def test_notebook_runs(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    import matplotlib.pyplot as plt

    plt.switch_backend("Agg")
    names: dict = {}
    for cell in get_code(NOTEBOOK):
        exec(compile(cell, str(NOTEBOOK), "exec"), names)
    plt.close("all")
    assert len(names["found"]) > 0 and names["cluster_ids"].max() > 0
