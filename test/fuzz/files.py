"""Part `files`: damaged files. A command that reads them gives a result, or one line and exit code
2."""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from fuzz.case import Case, Outcome, make_generator, pick
from fuzz.command import load_all, run_command
from fuzz.mutation import mutate_bytes, mutate_text

SECONDS, MEGABYTES = 60.0, 3000.0
KITTI = ("--data", "kitti")
DETECT = (
    "--out",
    "made",
    "--weights",
    "pointnet",
    "--limit",
    "2",
    "--png",
    "--format",
    "kitti,json,csv,mcap,openlabel",
)
# Label format -> its folder or file; the labels are of the drive in bag/.
LABELS = {
    "openlabel": "openlabel",
    "sustech": "sustech",
    "labelcloud": "labelcloud",
    "nuscenes_tracking": "nuscenes_tracking/labels.json",
}
# Format -> its weight, and the commands that read it; {} is the damaged file.
COMMANDS: dict[str, tuple[float, list[tuple[str, ...]]]] = {
    "bag": (
        8,
        [
            ("info", "bag/drive"),
            ("convert", "bag/drive", "--out", "made", "--force"),
            ("setup", "--data", "bag/drive", "--out", "made"),
            ("detect", "bag/drive", *DETECT),
        ],
    ),
    "ros1": (3, [("info", "ros1/drive.bag"), ("convert", "ros1/drive.bag", "--out", "made", "--force")]),
    "kitti": (4, [("convert", "kitti", "--out", "made", "--force"), ("evaluate", "candidates", *KITTI)]),
    "tracking": (
        2,
        [
            ("convert", "tracking", "--out", "made", "--force"),
            ("detect", "tracking", *DETECT, "--track", "--video", "made.gif"),
        ],
    ),
    "semantickitti": (3, [("evaluate", "segmentation", "--data", "semantickitti")]),
    "nuscenes": (3, [("convert", "nuscenes", "--out", "made", "--force")]),
    **{
        name: (1, [("convert", name, "--out", "made", "--force")])
        for name in ("pcd", "ply", "npy", "openpcdet", "odometry", "raw")
    },
    **{
        format: (1, [("convert", place, "--data", "bag/drive", "--to", "kitti_tracking", "--out", "made", "--force")])
        for format, place in LABELS.items()
    },
    "results": (2, [("evaluate", "detection", *KITTI, "--results", "results")]),
    "split": (1, [("convert", "kitti", "--out", "made", "--force", "--split", "{}")]),
    "template": (3, [("evaluate", "candidates", *KITTI, "--set", "seed.source=file", "--set", "seed.file={}")]),
    "yaml": (3, [("evaluate", "candidates", *KITTI, "--config", "{}")]),
    "sensor": (1, [("simulate", "--sensor", "{}", "--frames", "1", "--out", "made")]),
    "weights": (3, [("evaluate", "detection", *KITTI, "--limit", "1", "--weights", "{}")]),
    "fused": (1, [("evaluate", "detection", *KITTI, "--limit", "1", "--weights", "{}")]),
    "pth": (1, [("import-weights", "{}", "--out", "made.safetensors")]),
}
TEXT = (".txt", ".json", ".yaml", ".pcd", ".xml")
INSTEAD: dict[str, Callable[[Path], object]] = {
    "nothing": lambda path: None,
    "an empty file": Path.touch,
    "a folder": Path.mkdir,
    "a pipe": os.mkfifo,
    "a link to itself": lambda path: path.symlink_to(path.name),
    "zeros": lambda path: path.write_bytes(bytes(5000)),
}


@functools.cache
def load_samples() -> dict[str, bytes]:
    """Return {path: bytes} of all valid files."""
    with tempfile.TemporaryDirectory() as folder:
        # In another process, because threads that torch starts here would be missing in forks.
        subprocess.run([sys.executable, "-m", "fuzz.sample_files", folder], check=True)
        return {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(Path(folder).rglob("*"))
            if path.is_file()
        }


def make_case(seed: int, number: int) -> Case:
    """Return a case with one damaged file of one format, and a command that reads it."""
    rng = make_generator("files", seed, number)
    names = [name for name, (weight, _) in COMMANDS.items() for _ in range(int(weight))]
    name = pick(rng, names)
    path, instead = pick(rng, [path for path in load_samples() if path.startswith(f"{name}/")]), ""
    data = load_samples()[path]
    if rng.random() < 0.05:
        instead = what = pick(rng, list(INSTEAD))
    elif path.endswith(TEXT) and rng.random() < 0.8:
        text, what = mutate_text(data.decode(), rng)
        data = text.encode()
    else:
        data, what = mutate_bytes(data, rng)
    command = [word.format(path) for word in pick(rng, COMMANDS[name][1])]
    return Case(f"{path}: {what}; {' '.join(command)}", (path, instead, data, command))


class Attempt:
    """Run cases in a folder of valid files, one of which is replaced for each case."""

    def __init__(self, folder: Path):
        self.folder = folder
        for path, data in load_samples().items():
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
            (folder / path).write_bytes(data)
        os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
        load_all()

    def __call__(self, case: Case) -> Outcome:
        name, instead, data, command = case.settings
        path = self.folder / name
        try:
            _remove(path)
            INSTEAD[instead](path) if instead else path.write_bytes(data)
            return run_command(command, self.folder, SECONDS, MEGABYTES)
        finally:
            _remove(path)
            path.write_bytes(load_samples()[name])
            for made in self.folder.glob("made*"):
                _remove(made)


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
