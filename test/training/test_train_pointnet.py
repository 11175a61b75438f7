"""train pointnet on the command line."""

from __future__ import annotations

import json

import pytest
from click.testing import CliRunner

from lidar_perception.cli.main import cli
from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet.config import NETWORKS
from lidar_perception.detectors.pointnet.network import load_pointnet
from lidar_perception.detectors.weights_file import find_classifier_weights
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.sensor import find_sensor
from lidar_perception.training.params import PointNetTraining
from lidar_perception.types import InputError

# covered by other tests
pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread", "streets")]
SENSOR = "generic:16,-20,5,1.5,10"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """Folder of simulated scans and clusters that all tests share."""
    return tmp_path_factory.mktemp("cache")


def train(cache, out, *more, **changes):
    options = {
        "--data": "sim",
        "--sensor": SENSOR,
        "--data-scans": 2,
        "--data-val-scans": 1,
        "--data-people": 1,
        "--steps": 3,
        "--validate-steps": 3,
        "--log-steps": 1,
        "--batch": 1,
        "--jobs": 0,
        "--data-cache": cache,
        "--out": out,
        **changes,
    }
    words = [str(word) for pair in options.items() for word in pair]
    return CliRunner().invoke(cli, ["train", "pointnet", *words, *more])


def test_trained_network_opens_as_detector(cache, tmp_path):
    out = tmp_path / "run"
    result = train(cache, out)
    assert result.exit_code == 0, result.output
    assert len((out / "log.csv").read_text().splitlines()) == 4
    assert len(list((cache / "clusters").iterdir())) == 3
    header, network = load_pointnet(out / "last.safetensors")
    assert header.config.name == "improved" and header.training["steps"] == 3
    assert {"score", "accuracy", "calibration_error"} <= set(header.metrics)
    json.loads(header.to_json())
    assert network.offsets.abs().sum() > 0  # calibrated
    open_detector(out / "last.safetensors", "cpu")(simulate_scan(3, 0, find_sensor(SENSOR)).frame)
    # the same seed gives the same weights, also from the cache
    second_run = train(cache, tmp_path / "again")
    assert second_run.exit_code == 0
    assert _weights(tmp_path / "again") == _weights(out)
    twice = train(cache, out)
    assert isinstance(twice.exception, InputError) and "--resume" in str(twice.exception)
    assert train(cache, out, "--resume").exit_code == 0


def _weights(out):
    network = load_pointnet(out / "last.safetensors")[1]
    return {name: value.tolist() for name, value in network.state_dict().items()}


def test_proposer_is_recorded_and_must_be_pointpillars(cache, tmp_path):
    result = train(cache, tmp_path / "run", **{"--proposer": "package"})
    assert result.exit_code == 0, result.output
    training = read_header(tmp_path / "run/last.safetensors").training
    assert training["params"]["proposer"] == "package"
    for file, words in (
        (tmp_path / "none", "checkpoint not found"),
        (find_classifier_weights(), "not a PointPillars checkpoint"),
    ):
        result = train(cache, tmp_path / "bad", **{"--proposer": file})
        assert isinstance(result.exception, InputError) and words in str(result.exception)
        assert not (tmp_path / "bad").exists()


def test_network_option_lists_every_network():
    metadata = PointNetTraining.__dataclass_fields__["network"].metadata
    assert set(NETWORKS) == set(metadata["choices"])
