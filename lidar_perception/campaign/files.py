"""Damaged files through the commands that read them: each ends with a result, or with one line and
exit code 2."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from lidar_perception.campaign.case import Case, Outcome, generator, pick
from lidar_perception.campaign.command import load_all, run_command
from lidar_perception.campaign.mutation import mutate_bytes, mutate_text

SECONDS, MEGABYTES = 60.0, 3000.0
KITTI = ("--data", "kitti")
# Format of labels -> their place, a folder or a file; they are of the drive in bag/.
LABELS = {"openlabel": "openlabel", "sustech": "sustech", "labelcloud": "labelcloud",
          "nuscenes_tracking": "nuscenes_tracking/labels.json"}
# Format -> how often it is drawn, the commands that read it; {} is the damaged file.
COMMANDS: dict[str, tuple[float, list[tuple[str, ...]]]] = {
    "bag": (8, [("info", "bag/drive"), ("convert", "bag/drive", "--out", "made", "--force"),
                ("setup", "--data", "bag/drive", "--out", "made")]),
    "ros1": (3, [("info", "ros1/drive.bag"),
                 ("convert", "ros1/drive.bag", "--out", "made", "--force")]),
    "kitti": (4, [("convert", "kitti", "--out", "made", "--force"),
                  ("evaluate", "candidates", *KITTI)]),
    "tracking": (2, [("convert", "tracking", "--out", "made", "--force")]),
    "semantickitti": (3, [("evaluate", "segmentation", "--data", "semantickitti")]),
    "nuscenes": (3, [("convert", "nuscenes", "--out", "made", "--force")]),
    "pcd": (1, [("convert", "pcd", "--out", "made", "--force")]),
    **{format: (1, [("convert", place, "--data", "bag/drive", "--to", "kitti_tracking",
                     "--out", "made", "--force")]) for format, place in LABELS.items()},
    "results": (2, [("evaluate", "detection", *KITTI, "--results", "results")]),
    "split": (1, [("convert", "kitti", "--out", "made", "--force", "--split", "{}")]),
    "template": (3, [("evaluate", "candidates", *KITTI, "--set", "seed.source=file",
                      "--set", "seed.file={}")]),
    "yaml": (3, [("evaluate", "candidates", *KITTI, "--config", "{}")]),
    "sensor": (1, [("simulate", "--sensor", "{}", "--frames", "1", "--out", "made")]),
    "weights": (3, [("evaluate", "detection", *KITTI, "--limit", "1", "--weights", "{}")]),
    "fused": (1, [("evaluate", "detection", *KITTI, "--limit", "1", "--weights", "{}")]),
    "onnx": (1, [("evaluate", "detection", *KITTI, "--limit", "1", "--weights", "{}")]),
    "pth": (1, [("import-weights", "{}", "--out", "made.safetensors")]),
}
TEXT = (".txt", ".json", ".yaml", ".pcd")
INSTEAD = ("nothing", "an empty file", "a folder", "a pipe", "a link to itself", "zeros")


@functools.cache
def _made(what: str) -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as folder:
        # In a process of its own: threads that torch starts here would be missing in forked ones.
        subprocess.run([sys.executable, "-m", "lidar_perception.campaign.samples", what, folder],
                       check=True)
        return {path.relative_to(folder).as_posix(): path.read_bytes()
                for path in sorted(Path(folder).rglob("*")) if path.is_file()}


def sound(name: str) -> dict[str, bytes]:
    """Path of each file of a format -> its bytes."""
    return {path: data for path, data in _made(
        "write_onnx" if name == "onnx" else "write_samples").items()
        if path.startswith(f"{name}/")}


def case_of(seed: int, number: int) -> Case:
    """One file of one format, damaged, and a command."""
    rng = generator("files", seed, number)
    names = [name for name, (weight, _) in COMMANDS.items() for _ in range(int(weight))]
    name = pick(rng, names)
    files = sound(name)
    path, instead = pick(rng, sorted(files)), ""
    data = files[path]
    if rng.random() < 0.05:
        instead = what = pick(rng, INSTEAD)
        data = b""
    elif path.endswith(TEXT) and rng.random() < 0.8:
        text, what = mutate_text(data.decode(), rng)
        data = text.encode()
    else:
        data, what = mutate_bytes(data, rng)
    command = [word.format(path) for word in pick(rng, COMMANDS[name][1])]
    return Case("files", f"{path}: {what}; {' '.join(command)}", seed, number,
                {"path": path, "instead": instead, "command": command}, data)


class Attempt:
    """A folder with all sound files, of which one at a time is replaced."""

    def __init__(self, folder: Path):
        self.folder = folder
        for path, data in _made("write_samples").items():
            _put(folder / path, data)
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        load_all()

    def __call__(self, case: Case) -> Outcome:
        path = self.folder / case.settings["path"]
        try:
            _replace(path, case.settings["instead"], case.data)
            return run_command(case.settings["command"], self.folder, SECONDS).outcome(MEGABYTES)
        finally:
            _remove(path)
            name = case.settings["path"].partition("/")[0]
            if name != "onnx":
                _put(path, sound(name)[case.settings["path"]])
            for made in self.folder.glob("made*"):
                _remove(made)


def _put(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def _replace(path: Path, instead: str, data: bytes) -> None:
    _remove(path)
    path.parent.mkdir(parents=True, exist_ok=True)  # of what is made only where it is damaged
    if instead == "a folder":
        path.mkdir()
    elif instead == "a pipe":
        os.mkfifo(path)
    elif instead == "a link to itself":
        path.symlink_to(path.name)
    elif instead == "zeros":
        _put(path, bytes(5000))
    elif instead != "nothing":
        _put(path, data)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
