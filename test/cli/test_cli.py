"""The command line: help, results, exit codes and one line for what is wrong."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import click
import pytest
from cli_samples import error_line, exit_of
from click.testing import CliRunner
from mcap.writer import Writer
from samples import LABELS, WALKER, lowered_crowd, object_folder, walker_label, write

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.cli import info
from lidar_perception.cli.command import Command
from lidar_perception.cli.data import open_and_describe
from lidar_perception.cli.demo import _as_replayed, _params_of
from lidar_perception.cli.main import COMMANDS, cli
from lidar_perception.cli.options import detector_options, read_config
from lidar_perception.data.bag import Bag, BagWriter
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.param_fields import collect_fields, with_values
from lidar_perception.runs.terminal import Terminal
from lidar_perception.scoring.tables import make_table
from lidar_perception.types import InputError, closest_name
from lidar_perception.wire.topics import POINTS, TRUTH

STAGES = ("stage1", "stage2", "final")
RANGES = ("0-15", "15-30", "30-45", "45-60", "60+")
ROW = {"tp", "fp", "fn", "precision", "recall", "f1", "centre_error_m"}


def commands(group: click.Group, path: tuple = ()) -> list[tuple]:
    """Return (words, command) of every command that is not a group."""
    context, found = click.Context(group), []
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            found += commands(command, (*path, name))
        else:
            found.append(((*path, name), command))
    return found


LEAVES = commands(cli)


def run(*arguments) -> str:
    """Standard output of a command that succeeds."""
    result = CliRunner().invoke(cli, [str(a) for a in arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def evaluate(tmp_path, *arguments) -> dict:
    path = tmp_path / "made/by/evaluate/scores.json"
    run("evaluate", "candidates", "--json", path, *arguments)
    return json.loads(path.read_text())


def given(*assignments) -> list[str]:
    return [word for each in assignments for word in ("--set", each)]


def scores(content: dict) -> dict:
    """Return the scores without the run time."""
    return {k: v for k, v in content.items() if k != "ms"}


@pytest.fixture(scope="module")
def kitti(tmp_path_factory):
    """Two scans of a pedestrian, 3D-object layout."""
    return object_folder(tmp_path_factory.mktemp("kitti"), walker_label() + "\n")


@pytest.fixture(scope="module")
def bag(kitti, tmp_path_factory):
    path = tmp_path_factory.mktemp("bags") / "drive"
    run("convert", kitti, "--out", path)
    return path


@pytest.mark.parametrize("words", [words for words, _ in LEAVES], ids=" ".join)
def test_every_command_explains_itself_with_an_example(words):
    text = run(*words, "--help")
    assert "Usage: " in text and "Example" in text and f"lidar-perception {' '.join(words)}" in text


def test_the_overview_shows_every_command():
    text = run("--help")
    assert {words[0] for words, _ in LEAVES} == {*COMMANDS}
    for name, (_, summary) in COMMANDS.items():
        assert f"  {name} " in text and summary.split(".")[0] in " ".join(text.split())
    assert "lidar-perception" in run("--version")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_docstring(name):
    assert cli.get_command(click.Context(cli), name).help


@pytest.mark.parametrize(("words", "names"), [
    (("evaluate", "candidates"), ["stm.threshold (default 0.4)", "ground.method (default 'thr"]),
    (("evaluate", "detection", "--weights", "pointnet"), ["pointnet.scores.car (default 0.4)"]),
    (("evaluate", "clusters"), ["ground.method (default 'cloth')"]),
    (("evaluate", "tracking"), ["fused.same_place (default 0.6 m)", "tracking.min_score (defa"]),
    (("demo", "--detector=candidates"), ["view.enabled (default True)"])], ids=str)
def test_set_help_lists_the_parameters_of_what_runs(words, names):
    for spelling in ["--set", "help"], ["--set=help"]:
        text = run(*words, *spelling)
        assert all(name in text for name in names), text


def test_set_help_of_candidates_describes_every_parameter():
    text = run("evaluate", "candidates", "--set", "help")
    assert all(f"{name} (default" in text and f.metadata["doc"] in text
               for name, f in collect_fields(PAPER).items() if not name.startswith("input."))


def test_convert_makes_a_bag_of_every_scan(kitti, bag):
    with Bag(bag) as opened:
        assert opened.counts[POINTS] == opened.counts[TRUTH] == 2


def test_convert_takes_as_many_frames_as_asked_for(kitti, tmp_path):
    text = run("convert", kitti, "--out", tmp_path / "bag", "--limit", 1)
    assert "1 scans of 1" in text.replace("\n", "")
    with Bag(tmp_path / "bag") as opened:
        assert opened.counts[POINTS] == 1


def test_convert_leaves_out_what_is_broken_and_says_so(tmp_path, monkeypatch, capsys):
    root = object_folder(tmp_path / "kitti", LABELS)
    broken = write(root / "training/velodyne/000000.bin", b"123")
    assert exit_of(monkeypatch, "convert", root, "--out", tmp_path / "bag") == 1
    text = capsys.readouterr().out.replace("\n", "")
    assert "1 scans of 2" in text and str(broken) in text
    with Bag(tmp_path / "bag") as opened:
        assert opened.counts[POINTS] == 1


def test_convert_replaces_a_bag_only_by_force(kitti, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "300")
    out = tmp_path / "run [/final]"  # which is no markup
    command = ("convert", kitti, "--out", out, "--limit", 1)
    assert [exit_of(monkeypatch, *command), exit_of(monkeypatch, *command),
            exit_of(monkeypatch, *command, "--force"), exit_of(monkeypatch, "info", out)
            ] == [0, 2, 0, 0]
    assert capsys.readouterr().out.replace("\n", "").count("run [/final]") == 3


class Tty(io.StringIO):
    def isatty(self):
        return True


def test_info_folds_names_on_narrow_terminals_only(bag, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    with Bag(bag) as opened:
        topics, kinds = [*opened.topics], [*opened.topics.values()]
    text = run("info", bag)
    assert all(f"│ {topic} " in text for topic in topics) and str(bag) in text
    narrow = Terminal(file=Tty(), width=60, color_system=None)
    monkeypatch.setattr(info, "console", narrow)
    run("info", bag)
    text = narrow.file.getvalue()
    columns = [[cell.strip() for cell in line.split("│")[1:3]] for line in text.splitlines()
               if line.startswith("│")]
    assert "…" not in text and max(map(len, text.splitlines())) <= 60
    for names, cells in zip((topics, kinds), zip(*columns)):
        assert all(name in "".join(cells) for name in names)


@pytest.mark.parametrize("wide", [False, True])
def test_a_table_in_a_pipe_is_not_cut_whatever_its_width(wide, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    table = make_table("a title that is wider than its table" * (1 + 20 * wide), "", "score",
                       "another" * (1 + 30 * wide))
    table.add_row("a name of a detector", "100.0", "200.0")
    pipe = Terminal(file=io.StringIO())
    pipe.print(table)
    title, *rows = pipe.file.getvalue().splitlines()
    assert title == table.title
    assert rows[-2].split() == "a name of a detector 100.0 200.0".split()


def test_info_as_json_has_what_the_table_has(bag, kitti):
    content = json.loads(run("info", "--json", bag))
    with Bag(bag) as opened:
        assert {row["topic"]: (row["type"], row["messages"]) for row in content["topics"]} == {
            topic: (kind, opened.counts[topic]) for topic, kind in opened.topics.items()}
    assert content["seconds"] == pytest.approx(0.1)
    folder = json.loads(run("info", kitti, "--json"))
    assert (folder["frames"], folder["layout"]) == (2, "KITTI object data")
    assert folder["first_cloud"]["labels"] == ["Pedestrian"]


def test_bag_problem_is_one_line_and_command_continues(bag, tmp_path):
    shutil.copytree(bag, tmp_path / "bag")
    text = (bag / "metadata.yaml").read_text().replace("message_count: 2", "message_count: 9")
    (tmp_path / "bag/metadata.yaml").write_text(text)
    for command in (["info", tmp_path / "bag"],
                    ["convert", tmp_path / "bag", "--out", tmp_path / "out"]):
        result = CliRunner().invoke(cli, [*map(str, command)], catch_exceptions=False)
        assert result.exit_code == 0
        warned, = [line for line in result.stderr.splitlines() if "warning" in line]
        assert warned.startswith(
            f"warning: {tmp_path}/bag/metadata.yaml does not match the bag: it declares 9")


def test_info_lists_topics_that_are_not_read(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for name, encoding in (("Log", "protobuf"), ("Text", "cdr")):
            writer.register_channel(f"/{name}", encoding, writer.register_schema(name, "", b""))
        writer.finish()
    assert "Log as protobuf, not read" in run("info", tmp_path / "a.mcap")
    content = json.loads(run("info", tmp_path / "a.mcap", "--json"))
    assert [row["topic"] for row in content["unreadable"]] == ["/Log"]


def test_info_describes_a_recording_that_is_no_bag(kitti):
    text = run("info", kitti)
    assert f"{kitti}: KITTI object data, 2 frames, a camera, labelled boxes" in text
    assert "10 Hz assumed" in text and "first cloud: 000000, " in text and "labels: " in text


def test_info_shows_topics_types_counts_and_length(bag):
    text = run("info", bag)
    rows = {line.split("│")[1].strip(): line for line in text.splitlines() if "│ /" in line}
    with Bag(bag) as opened:
        assert {*rows} == {*opened.topics}
        for topic, kind in opened.topics.items():
            assert kind in rows[topic] and f" {opened.counts[topic]} " in rows[topic]
    assert "reliable, transient_local" in rows["/tf_static"]
    assert "reliable, volatile" in rows[POINTS]
    assert "0.1 s" in text


def test_the_scores_are_those_of_the_two_pedestrians(kitti, tmp_path):
    content = evaluate(tmp_path, "--data", kitti)
    assert (content["frames"], content["ground_truth"], content["skipped"]) == (2, 2, [])
    assert content["ground_truth_by_range"] == {r: 2 if r == "0-15" else 0 for r in RANGES}
    for stage in STAGES:
        assert content[stage].keys() == {*RANGES, "all"}
        assert all(content[stage][r].keys() == ROW for r in content[stage])
        for r in RANGES:
            row = content[stage][r]
            assert row["tp"] + row["fn"] == content["ground_truth_by_range"][r]
    for count in ("tp", "fp", "fn"):
        assert all(content[s]["all"][count] == sum(content[s][r][count] for r in RANGES)
                   for s in STAGES)
    assert content["final"]["0-15"]["recall"] == 1  # the seed is the pedestrian itself
    assert content["final"]["0-15"]["centre_error_m"] < WALKER[3]
    assert content["ms"]["total"] > 0 and all(ms >= 0 for ms in content["ms"].values())


def test_a_bag_has_the_scores_of_the_folder_it_was_made_of(kitti, bag, tmp_path):
    assert scores(evaluate(tmp_path, "--data", bag)) == scores(evaluate(tmp_path, "--data", kitti))


def test_evaluate_prints_what_it_writes(bag, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    text = run("evaluate", "candidates", "--data", bag, "--png", tmp_path / "a/picture.png")
    assert "2 pedestrians in 2 frames" in text
    assert (tmp_path / "a/picture.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("flags", [
    ("clustering.dbscan.min_samples=100000",), ("height.tolerance=0", "seed.source=file"),
    ("clustering.dbscan.eps=0.001,0.001,0.001",),
    ("view.enabled=false", "ground.threshold.max_height:=-10",
     "clustering.dbscan.range_limits=[5, 7]")])
def test_parameters_reach_the_pipeline(bag, tmp_path, flags):
    changed = scores(evaluate(tmp_path, "--data", bag, *given(*flags)))
    assert changed["ground_truth"] == 2
    assert changed != scores(evaluate(tmp_path, "--data", bag))


@pytest.mark.parametrize("words", [
    words for words, command in LEAVES
    if {"data", "data_option"} <= {p.name for p in command.params}], ids=" ".join)
def test_data_is_an_argument_and_data_option_is_the_same(words, tmp_path, monkeypatch, capsys):
    needs_out = "detect", "setup", "train", "seed"
    out = ("--out", tmp_path / "out") if words[0] in needs_out else ()
    results = ("--results", tmp_path / "r.json") if words[-1] == "nuscenes" else ()
    said = {}
    for name, given in {"argument": ["none"], "option": ["--data", "none"],
                        "both": ["none", "--data", "none"], "neither": []}.items():
        if name == "neither" and words[0] in ("demo", "view"):
            continue
        assert exit_of(monkeypatch, *words, *given, *out, *results) == 2
        said[name] = capsys.readouterr().err.splitlines()[-1]
    assert said["argument"] == said["option"] and "none does not exist" in said["argument"]
    assert "DATA is given twice" in said["both"]
    assert "DATA is missing" in said.get("neither", "DATA is missing")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [
    "train pointpillars sim --sensor vlp99", "train pointnet sim --scene stret",
    "train pointnet none", "train pointnet sim --init none", "train pointnet sim --set lrr=1",
    "train pointnet --ablation sim --sensor vlp99",
    "simulate --format kitti --sensor vlp99", "simulate --format kitti --scene stret",
    "simulate --format kitti --kind nowhere", "simulate --format kiti", "demo none",
    "demo --detector fuesd", "setup none", "setup {kitti} --topic /a", "label none",
    "label {kitti} --sequence 7", "label {kitti} --import openlabl:x",
    "convert none", "convert {kitti} --to kiti",
    "evaluate detection {kitti} --weights fussed", "detect {kitti} --weights fussed",
    "detect {kitti} --format kiti", "detect none", "seed none", "seed {kitti} --frame 9"])
def test_nothing_is_made_for_a_command_that_cannot_be_used(words, kitti, tmp_path, monkeypatch,
                                                           capsys):
    option = "--write-results" if words.startswith("evaluate") else "--out"
    assert exit_of(monkeypatch, *words.format(kitti=kitti).split(), option,
                   tmp_path / "not/there") == 2
    assert "Error: " in capsys.readouterr().err
    assert not (tmp_path / "not").exists()


@pytest.mark.parametrize("name", ["kitti", "KITTI", "kitti-object", "kitti_object"])
def test_names_of_formats_are_taken_in_any_spelling(kitti, tmp_path, name):
    run("convert", "--data", kitti, "--to", name, "--limit", 1, "--out", tmp_path / "k")
    assert (tmp_path / "k/training/velodyne").is_dir()
    run("simulate", "--to", name, "--frames", 1, "--out", tmp_path / "s")
    assert (tmp_path / "s/training/velodyne").is_dir()


def test_without_core_points_there_are_no_candidates(bag, tmp_path):
    content = evaluate(tmp_path, "--data", bag, *given("clustering.dbscan.min_samples=100000"))
    for stage in STAGES:
        row = content[stage]["all"]
        assert (row["tp"], row["fp"], row["fn"], row["f1"]) == (0, 0, 2, 0)
        assert row["centre_error_m"] is None


@pytest.mark.no_cover
def test_a_config_says_the_same_as_set_and_set_wins(bag, tmp_path):
    few, many = (given(f"clustering.dbscan.min_samples={n}") for n in (10, 100_000))
    file = write(tmp_path / "p.yaml",
                 "/**:\n  ros__parameters:\n    clustering.dbscan.min_samples: 100000\n")
    no_clusters = scores(evaluate(tmp_path, "--data", bag, *many))
    assert scores(evaluate(tmp_path, "--data", bag, "--config", file)) == no_clusters
    assert scores(evaluate(tmp_path, "--data", bag, "--config", file, *few)) == scores(
        evaluate(tmp_path, "--data", bag))


@pytest.mark.parametrize("section, words", [
    ("stm: 5", "'stm' is a group, not a value; it holds stm.threshold"),
    ("stm: {threshold: {of: 5}}", "'stm.threshold.of' is below a parameter"),
    ("5: 6", "5 is no name of a parameter"), ("{stm: {on: 1}}", "True is no name of a parameter"),
    ("[" * 700, "cannot read the parameter file"), ("a: 2001-99-99", "cannot read the param"),
    ("\n    ".join(["a0: &a0 {x: 1}"] + [f"a{i + 1}: &a{i + 1} {{x: *a{i}, y: *a{i}}}"
                                        for i in range(40)]), "more than 10000 parameters"),
    ("\n    ".join(["a0: &a0 {}"] + [f"a{i + 1}: &a{i + 1} {{x: *a{i}, y: *a{i}}}"
                                     for i in range(40)]), "more than 10000 parameters"),
    ("&a {b: *a}", "more than 20 others")], ids=range(9))
def test_a_parameter_file_says_nothing_that_is_passed_over(tmp_path, section, words):
    file = write(tmp_path / "p.yaml", f"/**:\n  ros__parameters:\n    {section}\n")
    with pytest.raises(InputError) as error:
        read_config(file, PipelineParams())
    assert words in str(error.value) and "\n" not in str(error.value)


def test_a_value_that_is_refused_is_shown_as_far_as_a_line_goes(tmp_path):
    lists = ["a0: &a0 [1, 1]", *(f"a{i + 1}: &a{i + 1} [*a{i}, *a{i}]" for i in range(40))]
    file = write(tmp_path / "p.yaml", "/**:\n  ros__parameters:\n    " + "\n    ".join(
        [*lists, "clustering.dbscan.min_samples: *a40"]))
    with pytest.raises(ValueError, match="must be of type int") as error:
        with_values(PipelineParams(), read_config(file, PipelineParams()))
    assert len(str(error.value)) < 500


@pytest.mark.parametrize("file", sorted(Path(__file__).parents[2].glob("config/*.yaml")),
                         ids=lambda path: path.name)
def test_our_parameter_files_are_read_whatever_the_command(file, capsys):
    read_config(file, PipelineParams())
    assert not capsys.readouterr().err


def test_misspelt_parameter_is_reported(tmp_path, capsys):
    file = write(tmp_path / "p.yaml", "/**:\n  ros__parameters:\n    other: {ground: 1}\n"
                 "    input.ahead: 3.0\n    ground: {sensor_pose: {heigth: 0.6}}\n")
    assert read_config(file, PipelineParams()) == {}
    said, = capsys.readouterr().err.splitlines()
    assert ".heigth', so it changes nothing; is 'ground.sensor_pose.height' meant" in said


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


def chosen(*arguments, tracking=False) -> dict:
    """Return the arguments of a command with detector_options."""
    made = {}

    @click.command(cls=Command)
    @detector_options(tracking=tracking)
    def verb(**given):
        made.update(given)
    verb.main([*map(str, arguments)], standalone_mode=False)
    return made


def test_only_the_sections_of_what_runs_are_read(tmp_path, capsys):
    file = write(tmp_path / "p.yaml", SECTIONS)
    made = chosen("--config", file, "--set", "crop.min_range=3", tracking=True)
    assert made["detector"].settings == {"ground.method": "threshold", "fused.scores.car": 0.7,
                                         "crop.min_range": 3.0}
    assert made["tracking"].min_score == 0.3
    other = chosen("--weights", "pointnet", "--config", file)["detector"]
    assert other.settings == {"ground.method": "threshold", "crop.min_range": 9.0,
                              "pointnet.min_points": 5}
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("text", "said"), [
    ("fused_detectr: {ros__parameters: {}}", "no node 'fused_detectr'; did you mean 'fused_detec"),
    ("/**: {ros__parameters: {fused.score.car: 1}}", "is 'fused.scores.car' meant?"),
    ("/**: {ros__parameters: {a: 1}}", "p.yaml has no parameter of fused")])
def test_what_may_be_misspelt_in_a_parameter_file_is_said(text, said, tmp_path, capsys):
    file = write(tmp_path / "p.yaml", text)
    assert chosen("--config", file)["detector"].settings == {}
    assert said in capsys.readouterr().err


def test_settings_of_a_detector_take_effect_and_win():
    """Over the threshold and the height that a verb gives, and in what is loaded."""
    made = chosen("--weights", "pointpillars", *given(
        "pointpillars.scores.car=0.7", "pointpillars.range=around", "pointpillars.device=cpu",
        "pointpillars.warm_up=no"))["detector"]
    detector = made.open(sensor_height=1.0, min_score=0.001)
    assert detector.min_scores == {"Car": 0.7, "Pedestrian": 0.001, "Cyclist": 0.001}
    assert detector.range == "around" and detector.params.ground.sensor_pose.height == 1.0
    with pytest.raises(InputError, match="give one of them"):
        DetectorChoice("f.json", settings={"fused.weights": "a"}).open()


def test_a_pipe_is_no_parameter_file_and_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is not a regular file"):
        read_config(tmp_path / "pipe", PipelineParams())


def test_a_frame_that_cannot_be_read_is_counted_as_skipped(kitti, tmp_path):
    root = object_folder(tmp_path / "kitti", walker_label(), count=3)
    write(root / "training/velodyne/000001.bin", b"123")
    content = evaluate(tmp_path, "--data", root)
    assert content["frames"] == 2
    line, = content["skipped"]
    assert "000001.bin" in line


BAD_INPUTS = {
    "missing bag": (["info", "{tmp}/none"], "the bag {tmp}/none does not exist"),
    "too long a name": (["info", f"{{tmp}}/{300 * 'a'}"], "a: File name too long"),
    "no bag": (["info", "{tmp}"], "{tmp} has no metadata.yaml and is no other recording: "
               "expected a rosbag2 bag, or the folder of KITTI"),
    "missing data": (["convert", "{tmp}/none", "--out", "{tmp}/o"], "{tmp}/none does not exist"),
    "no data": (["convert", "{tmp}", "--out", "{tmp}/o"],
                "{tmp} is not a recording in a supported format"),
    "existing out": (["convert", "{kitti}", "--out", "{bag}"], "exists already"),
    "out is a file": (["convert", "{kitti}", "--out", "{kitti}/training/calib/000000.txt",
                       "--force"], "is not a bag"),
    "out under a file": (["convert", "{kitti}", "--out",
                          "{kitti}/training/calib/000000.txt/o"], "cannot make the folder"),
    "out of range": (["evaluate", "candidates", "--data", "{bag}", "--set",
                      "ground.cloth.resolution=99"],
                     "ground.cloth.resolution = 99.0 is outside 0.1 .. 10.0"),
    "lengths": (["evaluate", "candidates", "--data", "{bag}", "--set",
                 "clustering.dbscan.eps=0.1"], "one more eps than range_limits"),
    "missing config": (["evaluate", "candidates", "--data", "{bag}", "--config", "{tmp}/none"],
                       "{tmp}/none"),
    "missing template": (["evaluate", "candidates", "--data", "{bag}", "--set",
                          "seed.source=file", "--set", "seed.file={tmp}/none"], "{tmp}/none"),
    "json under a file": (["evaluate", "candidates", "--data", "{bag}", "--json",
                           "{kitti}/training/calib/000000.txt/o"], "cannot be written"),
    "json is a folder": (["evaluate", "candidates", "--data", "{tmp}/none", "--json", "{tmp}"],
                         "{tmp} cannot be written"),
    "detector": (["evaluate", "detection", "--data", "{kitti}", "--weights", "fussed"],
                 "'fussed'; did you mean 'fused'? Valid names: pointpillars, pointnet, fused"),
    "no standard output": (["evaluate", "candidates", "--data", "{tmp}/none", "--json", "-"],
                           "- cannot be written; give the name of a file"),
}


@pytest.mark.parametrize("case", BAD_INPUTS)
def test_bad_input_is_one_line_on_stderr_and_exit_code_2(case, kitti, bag, tmp_path, monkeypatch,
                                                         capsys):
    def fill(text):
        return text.format(tmp=tmp_path, kitti=kitti, bag=bag)

    arguments, words = BAD_INPUTS[case]
    assert exit_of(monkeypatch, *map(fill, arguments)) == 2
    assert fill(words) in error_line(capsys)


def test_a_bag_without_a_cloud_is_bad_input(tmp_path, monkeypatch, capsys):
    with BagWriter(tmp_path / "bag") as made:
        made.add_topic(POINTS, "sensor_msgs/msg/PointCloud2")
    for command in "nuscenes", "detection":
        assert exit_of(monkeypatch, "evaluate", command, "--data", tmp_path / "bag", "--weights",
                       "fused", "--write-results", tmp_path / "out") == 2
        assert "has no frames" in error_line(capsys)


def test_no_pedestrian_is_bad_input_and_leaves_the_scores(tmp_path, monkeypatch, capsys):
    root = object_folder(tmp_path / "kitti", "")
    write(tmp_path / "s.json", "those from before")
    assert exit_of(monkeypatch, "evaluate", "candidates", "--data", root, "--json",
                   tmp_path / "s.json") == 2
    assert "no frame with a Pedestrian label" in capsys.readouterr().err
    assert (tmp_path / "s.json").read_text() == "those from before"


@pytest.mark.parametrize("arguments, words", [
    (["bogus"], "there is no command 'bogus'; valid names: demo"),
    (["evaluate", "candidates"], "DATA is missing"),
    (["evaluate", "candidates", "--data", "a", "--jobs", "2", "--dask", "b"], "give one of them"),
    (["evaluate", "candidates", "--data", "b", "--set", "clustering.dbscan.min_samples=few"],
     "must be a whole number"),
    (["evaluate", "candidates", "--data", "b", "--set", "clustering.dbscan.eps=0.1,wide"],
     "list of numbers"),
    (["evaluate", "candidates", "--data", "b", "--set", "seed.source=luck"], "'luck'"),
    (["evaluate", "candidates", "--data", "b", "--set", "stm.threshold"], "must be NAME=VALUE"),
    (["evaluate", "detection", "--data", "b", "--set", "fused.score.car=1"],
     "did you mean 'fused.scores.car'?"),
    (["detect", "b", "--out", "o", "--set", "input.intensity_max=255"], "which nodes read"),
    (["demo", "b", "--frames", "4"], "--frames is for a simulated drive"),
    (["evaluate", "detection", "b", "--results", "r", "--min-score", "0.1"], "--min-score is for"),
    (["evaluate", "detection", "b", "--errors-from", "0.1"], "--errors-from goes with --errors"),
    (["evaluate", "detection", "--data", "b", "--set", "scores=1"], "no parameter 'scores'"),
    (["evaluate", "detection", "--data", "b", "--results", "r", "--set", "fused.amp=auto"],
     "give either --results"),
    (["evaluate", "detection", "--data", "b", "--wieghts", "fused"], "did you mean '--weights'?"),
    (["evaluate", "candidates", "--data", "b", "--config", "bset"], "did you mean 'best'?"),
    (["evaluate", "candidates", "--data", "b", "--stm-threshold", "0.5"],
     "given as --set stm.threshold=VALUE"),
    (["evaluate", "trakcing"], "did you mean 'tracking'? Valid names: candidates, clusters"),
    (["evalute"], "did you mean 'evaluate'? Valid names: demo, convert"),
    (["run", "fused"], "did you mean 'fused_detector'?"),
    (["convert", "a", "--out", "b", "--limit", "0"], "0 is not in the range"),
    (["convert", "a"], "--out"),
    (["simulate", "--frames", "1", "--out", "."], "no name for a new file"),
    (["run", "bogus"], "'bogus'"),
])
def test_a_command_that_cannot_be_used_is_exit_code_2(arguments, words, monkeypatch, capsys):
    assert exit_of(monkeypatch, *arguments) == 2
    assert words in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(("name", "known", "closest"), [
    ("fussed", ["pointnet", "fused"], "fused"), ("fused", ["tracker", "fused_detector"],
                                                 "fused_detector"),
    ("vlp99", ["hdl-64e", "vlp-16", "vlp-32c"], "vlp-16"), ("KITTI_traking", ["kitti-tracking"],
                                                           "kitti-tracking"),
    ("luck", ["seeds", "points"], None), ("", ["a"], None), (None, ["x"], None)])
def test_the_closest_name_is_found_where_there_is_one(name, known, closest):
    assert closest_name(name, known) == closest


@pytest.mark.parametrize("arguments, code, words", [
    (["--version"], 0, ""), (["info", "none"], 2, "Error: the bag none does not exist\n")])
def test_the_process_ends_with_the_code(arguments, code, words, tmp_path):
    done = subprocess.run([sys.executable, "-m", "lidar_perception.cli.main", *arguments],
                          cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (code, words)


@pytest.mark.no_cover
def test_real_scans_are_scored_alike_from_folder_and_bag(data, tmp_path):
    root = data / "kitti_object"
    run("convert", root, "--out", tmp_path / "bag", "--limit", 6)
    content = evaluate(tmp_path, "--data", tmp_path / "bag")
    labels = [path.read_text() for path in sorted(root.glob("training/label_2/*.txt"))[:6]]
    counts = [sum(line.startswith("Pedestrian ") for line in text.splitlines()) for text in labels]
    assert content["frames"] == sum(n > 0 for n in counts)
    assert content["ground_truth"] == sum(counts)


@pytest.mark.parametrize("command", [["demo"], ["run", "perception"]])
def test_without_rclpy_the_remedy_is_said_before_any_work(command, tmp_path):
    write(tmp_path / "rclpy/__init__.py", "raise ImportError('not for this Python')")
    end = subprocess.run([sys.executable, "-m", "lidar_perception.cli.main", *command],
                         capture_output=True, text=True, cwd=tmp_path,
                         env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(
                             None, sys.path)])})
    assert end.returncode == 2
    assert end.stderr.strip().splitlines()[-1].endswith(
        "cannot load rclpy (not for this Python): source ROS 2 Jazzy, or pip install "
        "'lidar_perception[ros]'")
    assert not (tmp_path / "out").exists()


def test_demo_tells_its_nodes_how_high_the_sensor_is(tmp_path):
    """As measured in the bag that it replays, which says nothing of it."""
    write_bag(tmp_path / "bag", [lowered_crowd(i, 1.0) for i in range(3)])
    recording = open_and_describe(tmp_path / "bag")
    played = _as_replayed(recording.path, recording)
    pose = _params_of(DetectorChoice("candidates"), played).ground.sensor_pose
    assert pose.height == pytest.approx(0.7, abs=0.02)
