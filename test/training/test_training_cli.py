"""train pointpillars on the command line."""

from __future__ import annotations

import dataclasses
import functools
import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from samples import make_walker_label, write_file, write_object_folder

from lidar_perception.cli.main import cli
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.detectors.pointpillars.detector import load_detector
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.training.params import PAPER_VAL_FRACTION, DataParams, PointPillarsTraining
from lidar_perception.training.request import TrainingRequest
from lidar_perception.training.sources import open_sources
from lidar_perception.types import InputError

pytestmark = [
    pytest.mark.no_cover,  # covered by other tests
    pytest.mark.usefixtures("one_thread", "streets"),
]
SENSOR = "generic:16,-20,5,2,10"


def train(*arguments):
    return CliRunner().invoke(cli, ["train", "pointpillars", *map(str, arguments)])


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Folder of simulated scans that all tests share."""
    return tmp_path_factory.mktemp("cache")


def train_on_simulation(cache, out, **changes):
    options = {
        "--data": "sim",
        "--sensor": SENSOR,
        "--data-scans": 1,
        "--data-val-scans": 1,
        "--data-people": 1,
        "--steps": 4,
        "--validate-steps": 2,
        "--log-steps": 1,
        "--batch": 2,
        "--jobs": 0,
        "--data-cache": cache,
        "--out": out,
        **changes,
    }
    return [word for pair in options.items() for word in pair]


def test_trained_network_opens_as_detector(tmp_path, cache, tiny_size):
    out = tmp_path / "run"
    result = train(*train_on_simulation(cache, out), "--version", "v4", "--seed", 5)
    assert result.exit_code == 0, result.output
    assert len((out / "log.csv").read_text().splitlines()) == 5
    assert len((out / "validation.csv").read_text().splitlines()) == 3
    assert len(list(cache.glob("*.npz"))) == 2
    header = read_header(out / "last.safetensors")
    assert (header.config.version, header.config.size) == ("v4", "compact")
    record = header.training
    assert (record["steps"], record["seed"], record["batch"], record["scenes"]) == (4, 5, 2, 1)
    assert record["data"] == ["sim"] and record["params"]["sensor"] == SENSOR
    assert "score" in header.metrics and header.commit
    json.loads(header.to_json())
    detector = load_detector(out / "best.safetensors", "cpu")
    detector(simulate_scan(3, 0, find_sensor(SENSOR)).frame)
    # a finished run does not change
    before = (out / "last.safetensors").read_bytes()
    second_run = train(*train_on_simulation(cache, out), "--version", "v4", "--seed", 5)
    assert second_run.exit_code == 1 and "--resume" in str(second_run.exception)
    assert train(*train_on_simulation(cache, out), "--version", "v4", "--seed", 5, "--resume").exit_code == 0
    assert (out / "last.safetensors").read_bytes() == before
    # another run starts from its weights
    init = train(
        *train_on_simulation(cache, tmp_path / "next", **{"--steps": 1}),
        "--version",
        "v4",
        "--init",
        out / "last.safetensors",
    )
    assert init.exit_code == 0, init.output
    other = train(
        *train_on_simulation(cache, tmp_path / "other", **{"--steps": 1}),
        "--version",
        "v0",
        "--init",
        out / "last.safetensors",
        "--ahead",
        20,
        "--amp",
        "bf16",
    )
    assert other.exit_code == 0, other.output
    assert "the others are initialised at random" in other.output
    assert read_header(tmp_path / "other/last.safetensors").config.high == header.config.high


def test_broken_scenes_of_a_mixture_are_counted(tmp_path, cache, tiny_size):
    root = write_object_folder(tmp_path / "kitti", make_walker_label() + "\n", 6)
    write_file(root / "training/label_2/000002.txt", "Pedestrian 0 0 x\n")
    result = train(
        *train_on_simulation(cache, tmp_path / "run"),
        "--data",
        root,
        "--version",
        "v0",
        "--data-val-share",
        0.2,
        "--augment-cyclists",
        0,
    )
    assert result.exit_code == 0, result.output
    assert "1 scenes were skipped" in result.output and "000002.txt" in result.output
    header = read_header(tmp_path / "run/best.safetensors")
    assert header.training["scenes"] == 5 + 1 and header.training["scenes_skipped"] == 1
    assert header.metrics["Pedestrian_3d"] is not None


def open_data(data, val=(), split=None, val_split=None, **data_params) -> tuple[tuple, tuple]:
    request = TrainingRequest(data, val, split, val_split, Path("out"), False, None, "cpu", 0)
    return open_sources(request, PointPillarsTraining(data=DataParams(**data_params)))


def test_held_out_frames_are_not_trained_on(tmp_path):
    root = write_object_folder(tmp_path, count=5)
    open_frames = functools.partial(open_data, scans=7, val_scans=2, val_share=0.4)

    def count_frames(*arguments) -> list[list[int]]:
        return [[len(source) for source in sources] for sources in open_frames(*arguments)]

    folder = str(root)
    (train_on, *_), (held, *_) = open_frames((folder,))
    assert (len(train_on), len(held)) == (3, 2) and not {*train_on.names} & {*held.names}
    assert count_frames((folder, "sim")) == [[3, 7], [2, 2]]
    assert count_frames((folder,), ("sim",)) == [[5], [2]]
    assert count_frames(("sim",), (folder,)) == [[7], [5]]
    (streets,), (others,) = open_frames(("sim",))
    assert streets.first_seed + streets.count <= others.first_seed
    ours, theirs = write_file(tmp_path / "a", "000000\n000001\n"), write_file(tmp_path / "b", "000001\n")
    (train_on,), (held,) = open_frames((folder,), (folder,), ours, theirs)
    assert (train_on.names, held.names) == (("000000",), ("000001",))
    (train_on,), (held,) = open_frames((folder,), (), None, theirs)
    assert len(train_on) == 4 and held.names == ("000001",)
    with pytest.raises(InputError, match="--split"):
        open_frames(("sim",), (), ours)
    with pytest.raises(InputError, match="--val-split"):
        open_frames(("sim",), (), None, theirs)
    with pytest.raises(InputError, match="no frame is left"):
        open_frames((folder,), (folder,), theirs, theirs)


def test_training_and_validation_share_no_frame_by_any_path(tmp_path, monkeypatch):
    root = write_object_folder(tmp_path / "kitti", make_walker_label() + "\n", 5)
    write_bag(tmp_path / "bag", open_recording(root))
    (file,) = (tmp_path / "bag").glob("*.mcap")
    monkeypatch.chdir(tmp_path)
    some = write_file(tmp_path / "some.txt", "000000\n000001\n")
    three = [f"{i:06}" for i in (2, 3, 4)]

    def names(*arguments) -> list[list[str]]:
        """Return the names of the frames to train on and to validate on."""
        return [
            sorted(name for source in sources for name in source.names)
            for sources in open_data(*arguments, val_share=0.4)
        ]

    for other in (str(root), "kitti", "kitti/training", "../" + tmp_path.name + "/kitti"):
        assert names((str(root),), (other,), some, None) == [["000000", "000001"], three]
        assert names((str(root),), (other,), None, some) == [three, ["000000", "000001"]]
        with pytest.raises(InputError, match="no frame is left to train on"):
            names((str(root),), (other,), None, None)
        train_on, held = names((str(root), other), (), None, None)
        assert len(held) == 4 and not {*train_on} & {*held}
    with pytest.raises(InputError, match="no frame is left to train on"):
        names(("bag",), (str(file),), None, None)


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["--data", "nowhere"], "nowhere does not exist; give a bag or the folder of a data set"),
        (["--data", "sim", "--sensor", "lidar9000"], "lidar9000"),
        (["--data", "sim", "--device", "tpu"], "tpu"),
        (["--data", "sim", "--lr", "0"], "lr = 0"),
        (["--data", "sim", "--init", "missing.safetensors"], "missing.safetensors"),
    ],
)
def test_bad_input_is_rejected_at_once(tmp_path, tiny_size, arguments, reason):
    result = train(
        *arguments,
        "--out",
        tmp_path / "run",
        "--jobs",
        0,
        "--data-scans",
        1,
        "--augment-cars",
        0,
        "--augment-pedestrians",
        0,
        "--augment-cyclists",
        0,
        "--augment-things",
        0,
    )
    assert isinstance(result.exception, InputError) and reason in str(result.exception)
    assert not (tmp_path / "run" / "last.pt").exists()


def test_held_out_fraction_defaults_to_the_paper():
    assert round(PAPER_VAL_FRACTION * 7518) == 751
    text = train("--help").output
    for group in PointPillarsTraining, DataParams:
        for f in dataclasses.fields(group):
            assert "--" in text and f.name.replace("_", "-") in text


def test_file_as_out_is_rejected_before_simulation(tmp_path, monkeypatch):
    def never(*_):
        raise AssertionError("data was prepared")

    monkeypatch.setattr("lidar_perception.training.start.open_sources", never)
    file = write_file(tmp_path / "out", b"")
    for out in (file, file / "below"):
        for kind in ("pointpillars", "pointnet"):
            result = CliRunner().invoke(cli, ["train", kind, "--data", "sim", "--out", str(out)])
            assert isinstance(result.exception, InputError) and str(out) in str(result.exception)
