"""The command setup: readable files, nothing overwritten, clear errors."""

import json

import pytest
import yaml
from click.testing import CliRunner
from tilted_samples import simulate_clouds

from lidar_perception.candidates.params import PipelineParams
from lidar_perception.cli.main import cli
from lidar_perception.cli.options import read_config
from lidar_perception.cli.setup import FILES
from lidar_perception.data.bag import BagWriter
from lidar_perception.param_fields import with_values
from lidar_perception.simulation.sensor import load_sensor
from lidar_perception.types import InputError


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "drive"
    with BagWriter(path) as writer:
        writer.add_topic("/lidar/points", "sensor_msgs/msg/PointCloud2")
        for i, msg in enumerate(simulate_clouds("vlp-16", 6)):
            writer.write("/lidar/points", i * 10**8, msg)
    return path


def run(*arguments):
    result = CliRunner().invoke(cli, ["setup", *map(str, arguments)])
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


@pytest.fixture(scope="module")
def setup_folder(bag, tmp_path_factory):
    out = tmp_path_factory.mktemp("setup") / "robot"
    result = run("--data", bag, "--out", out, "--height-hint", 1.2)
    assert result.exit_code == 0
    assert "vlp-16" in result.output and "warning: the sensor is 0.60 m above" in " ".join(result.output.split())
    return out


def test_every_file_is_written_and_readable(setup_folder):
    assert sorted(p.name for p in setup_folder.iterdir()) == sorted(FILES)
    assert load_sensor(setup_folder / "sensor.yaml").rings == 16
    params = with_values(PipelineParams(), read_config(setup_folder / "robot.param.yaml", PipelineParams()))
    assert params.ground.sensor_pose.height == pytest.approx(0.6, abs=0.02)
    assert params.ground.sensor_pose.pitch == pytest.approx(0.1396, abs=0.0035)
    assert params.input.intensity_max == 255
    assert params.resolution.elevation_step == pytest.approx(2)
    layout = (setup_folder / "foxglove_layout.json").read_text()
    assert '"/lidar/points"' in layout and json.loads(layout)
    assert "Fixed Frame: lidar\n" in (setup_folder / "lidar_perception.rviz").read_text()
    assert yaml.safe_load((setup_folder / "lidar_perception.rviz").read_text())


@pytest.mark.no_cover
def test_files_are_replaced_only_with_force(setup_folder, bag):
    before = {p.name: p.read_bytes() for p in setup_folder.iterdir()}
    with pytest.raises(InputError, match="--force"):
        run("--data", bag, "--out", setup_folder)
    assert {p.name: p.read_bytes() for p in setup_folder.iterdir()} == before
    assert run("--data", bag, "--out", setup_folder, "--topic", "/lidar/points", "--scans", 2, "--force").exit_code == 0


def test_simulate_accepts_measured_sensor(setup_folder, tmp_path):
    result = CliRunner().invoke(
        cli,
        [
            "simulate",
            "--sensor",
            str(setup_folder / "sensor.yaml"),
            "--frames",
            "1",
            "--format",
            "semantickitti",
            "--out",
            str(tmp_path / "street"),
            "--jobs",
            "1",
        ],
    )
    assert result.exit_code == 0, result.output


def test_bad_input_leaves_no_file(tmp_path, bag):
    (tmp_path / "one.pcd").write_text("no cloud")
    for data, words in ((tmp_path / "none", "does not exist"), (tmp_path / "one.pcd", "not a readable PCD file")):
        with pytest.raises(InputError, match=words):
            run("--data", data, "--out", tmp_path / "robot")
    with pytest.raises(InputError, match="no topic"):
        run("--data", bag, "--topic", "/other", "--out", tmp_path / "robot")
    assert not (tmp_path / "robot").exists()
