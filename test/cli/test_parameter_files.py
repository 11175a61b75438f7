"""Parameter files and --set on the command line."""

from __future__ import annotations

import os
from pathlib import Path

import click
import pytest
from cli_samples import drop_times, evaluate, make_set_options, run_command
from samples import write_file

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.cli.command import Command
from lidar_perception.cli.options import detector_options, read_config
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.param_fields import collect_fields, with_values
from lidar_perception.types import InputError


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("evaluate", "candidates"), ["stm.threshold (default 0.4)", "ground.method (default 'thr"]),
        (("evaluate", "detection", "--weights", "pointnet"), ["pointnet.scores.car (default 0.4)"]),
        (("evaluate", "clusters"), ["ground.method (default 'cloth')"]),
        (("evaluate", "tracking"), ["fused.same_place (default 0.6 m)", "tracking.min_score (defa"]),
        (("demo", "--detector=candidates"), ["view.enabled (default True)"]),
    ],
    ids=str,
)
def test_set_help_lists_the_parameters_of_the_command(words, names):
    for spelling in ["--set", "help"], ["--set=help"]:
        text = run_command(*words, *spelling)
        assert all(name in text for name in names), text


def test_set_help_of_candidates_describes_every_parameter():
    text = run_command("evaluate", "candidates", "--set", "help")
    assert all(
        f"{name} (default" in text and f.metadata["doc"] in text
        for name, f in collect_fields(PAPER).items()
        if not name.startswith("input.")
    )


@pytest.mark.parametrize(
    "flags",
    [
        ("clustering.dbscan.min_samples=100000",),
        ("height.tolerance=0", "seed.source=file"),
        ("clustering.dbscan.eps=0.001,0.001,0.001",),
        ("view.enabled=false", "ground.threshold.max_height:=-10", "clustering.dbscan.range_limits=[5, 7]"),
    ],
)
def test_set_changes_parameters_of_the_pipeline(bag, tmp_path, flags):
    changed_scores = drop_times(evaluate(tmp_path, "--data", bag, *make_set_options(*flags)))
    assert changed_scores["ground_truth"] == 2
    assert changed_scores != drop_times(evaluate(tmp_path, "--data", bag))


@pytest.mark.no_cover
def test_set_takes_precedence_over_config(bag, tmp_path):
    few, many = (make_set_options(f"clustering.dbscan.min_samples={n}") for n in (10, 100_000))
    file = write_file(tmp_path / "p.yaml", "/**:\n  ros__parameters:\n    clustering.dbscan.min_samples: 100000\n")
    no_clusters = drop_times(evaluate(tmp_path, "--data", bag, *many))
    assert drop_times(evaluate(tmp_path, "--data", bag, "--config", file)) == no_clusters
    assert drop_times(evaluate(tmp_path, "--data", bag, "--config", file, *few)) == drop_times(
        evaluate(tmp_path, "--data", bag)
    )


@pytest.mark.parametrize(
    "section, words",
    [
        ("stm: 5", "'stm' is a group, not a value; it contains stm.threshold"),
        ("stm: {threshold: {of: 5}}", "'stm.threshold.of' is nested in a parameter"),
        ("5: 6", "5 is not a parameter name"),
        ("{stm: {on: 1}}", "True is not a parameter name"),
        ("[" * 700, "cannot read the parameter file"),
        ("a: 2001-99-99", "cannot read the param"),
        (
            "\n    ".join(["a0: &a0 {x: 1}"] + [f"a{i + 1}: &a{i + 1} {{x: *a{i}, y: *a{i}}}" for i in range(40)]),
            "at most 10000 parameters",
        ),
        (
            "\n    ".join(["a0: &a0 {}"] + [f"a{i + 1}: &a{i + 1} {{x: *a{i}, y: *a{i}}}" for i in range(40)]),
            "at most 10000 parameters",
        ),
        ("&a {b: *a}", "20 levels of nesting"),
    ],
    ids=range(9),
)
def test_ignored_entries_of_a_parameter_file_are_reported(tmp_path, section, words):
    file = write_file(tmp_path / "p.yaml", f"/**:\n  ros__parameters:\n    {section}\n")
    with pytest.raises(InputError) as error:
        read_config(file, PipelineParams())
    assert words in str(error.value) and "\n" not in str(error.value)


def test_long_invalid_value_is_abbreviated_in_the_error(tmp_path):
    lists = ["a0: &a0 [1, 1]", *(f"a{i + 1}: &a{i + 1} [*a{i}, *a{i}]" for i in range(40))]
    file = write_file(
        tmp_path / "p.yaml",
        "/**:\n  ros__parameters:\n    " + "\n    ".join([*lists, "clustering.dbscan.min_samples: *a40"]),
    )
    with pytest.raises(ValueError, match="must be of type int") as error:
        with_values(PipelineParams(), read_config(file, PipelineParams()))
    assert len(str(error.value)) < 500


@pytest.mark.parametrize("file", sorted(Path(__file__).parents[2].glob("config/*.yaml")), ids=lambda path: path.name)
def test_shipped_parameter_files_load_without_warnings(file, capsys):
    read_config(file, PipelineParams())
    assert not capsys.readouterr().err


def test_misspelled_parameter_is_reported(tmp_path, capsys):
    file = write_file(
        tmp_path / "p.yaml",
        "/**:\n  ros__parameters:\n    other: {ground: 1}\n"
        "    input.ahead: 3.0\n    ground: {sensor_pose: {heigth: 0.6}}\n",
    )
    assert read_config(file, PipelineParams()) == {}
    (line,) = capsys.readouterr().err.splitlines()
    assert ".heigth' is ignored; did you mean 'ground.sensor_pose.height'" in line


SECTIONS = """
/**:
  ros__parameters: {ground: {method: threshold}, base_frame: base_link, other: {x: 1}}
fused_detector:
  ros__parameters: {fused: {scores: {car: 0.7}}, crop: {min_range: 2.0}}
/robot/pointnet_detector:
  ros__parameters: {crop: {min_range: 9.0}, pointnet: {min_points: 5}}
tracker:
  ros__parameters: {tracking: {min_score: 0.3}}
somebody_elses_node:
  ros__parameters: {fused: {scores: {cyclist: 0.9}}}
"""


def parse_options(*arguments, tracking=False) -> dict:
    """Return the values that a command with detector_options() receives."""
    options = {}

    @click.command(cls=Command)
    @detector_options(tracking=tracking)
    def command(**values):
        options.update(values)

    command.main([*map(str, arguments)], standalone_mode=False)
    return options


def test_only_sections_of_the_command_are_read(tmp_path, capsys):
    file = write_file(tmp_path / "p.yaml", SECTIONS)
    options = parse_options("--config", file, "--set", "crop.min_range=3", tracking=True)
    assert options["detector"].settings == {
        "ground.method": "threshold",
        "fused.scores.car": 0.7,
        "crop.min_range": 3.0,
    }
    assert options["tracking"].min_score == 0.3
    other = parse_options("--weights", "pointnet", "--config", file)["detector"]
    assert other.settings == {"ground.method": "threshold", "crop.min_range": 9.0, "pointnet.min_points": 5}
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("fused_detectr: {ros__parameters: {}}", "unknown node 'fused_detectr'; did you mean 'fused_detec"),
        ("/**: {ros__parameters: {fused.score.car: 1}}", "did you mean 'fused.scores.car'?"),
        ("/**: {ros__parameters: {a: 1}}", "p.yaml has no parameter of fused"),
    ],
)
def test_probable_typos_in_a_parameter_file_are_reported(text, said, tmp_path, capsys):
    file = write_file(tmp_path / "p.yaml", text)
    assert parse_options("--config", file)["detector"].settings == {}
    assert said in capsys.readouterr().err


def test_detector_settings_take_precedence_over_options():
    choice = parse_options(
        "--weights",
        "pointpillars",
        *make_set_options(
            "pointpillars.scores.car=0.7",
            "pointpillars.range=around",
            "pointpillars.device=cpu",
            "pointpillars.warm_up=no",
        ),
    )["detector"]
    detector = choice.open(sensor_height=1.0, min_score=0.001)
    assert detector.min_scores == {"Car": 0.7, "Pedestrian": 0.001, "Cyclist": 0.001}
    assert detector.range == "around" and detector.params.ground.sensor_pose.height == 1.0
    with pytest.raises(InputError, match="give only one of them"):
        DetectorChoice("f.json", settings={"fused.weights": "a"}).open()


def test_named_pipe_as_parameter_file_is_rejected(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is not a regular file"):
        read_config(tmp_path / "pipe", PipelineParams())
