"""The command line: help, results, exit codes and error lines."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys

import click
import pytest
from cli_samples import drop_times, evaluate, make_set_options, run_command, run_main
from click.testing import CliRunner
from mcap.writer import Writer
from samples import LABELS, WALKER, make_lowered_crowd, make_walker_label, write_file, write_object_folder

from experiments.__main__ import cli as experiments_cli
from lidar_perception.cli import info
from lidar_perception.cli.data import open_and_describe
from lidar_perception.cli.demo import _load_node_params, _open_replayed_bag
from lidar_perception.cli.main import COMMANDS, cli
from lidar_perception.data.bag import Bag
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.open import DetectorChoice
from lidar_perception.runs.terminal import Terminal
from lidar_perception.scoring.tables import make_table
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


@pytest.mark.parametrize("words", [words for words, _ in LEAVES], ids=" ".join)
def test_help_of_every_command_has_an_example(words):
    text = run_command(*words, "--help")
    assert "Usage: " in text and "Example" in text and f"lidar-perception {' '.join(words)}" in text


@pytest.mark.parametrize("group, program", [(cli, "lidar-perception"), (experiments_cli, "./lidar")])
def test_examples_use_options_that_exist(group, program):
    leaves = {words: command for words, command in commands(group) if words != ("run",)}  # run passes its options on
    helps = "\n".join(command.help for command in (group, *leaves.values())).replace("\\\n", " ")
    examples = [line.split() for line in re.findall(rf"{re.escape(program)} (.*)", helps)]
    for words, command in leaves.items():
        options = {name for param in command.params for name in (*param.opts, *param.secondary_opts)}
        for example in examples:
            if tuple(example[: len(words)]) == words:
                assert {word.split("=")[0] for word in example if word.startswith("--")} <= options, example


def test_overview_shows_every_command():
    text = run_command("--help")
    assert {words[0] for words, _ in LEAVES} == {*COMMANDS}
    for name, (_, summary) in COMMANDS.items():
        assert f"  {name} " in text and summary.split(".")[0] in " ".join(text.split())
    assert "lidar-perception" in run_command("--version")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_a_docstring(name):
    assert cli.get_command(click.Context(cli), name).help


def test_convert_writes_every_scan_to_the_bag(kitti, bag):
    with Bag(bag) as opened:
        assert opened.counts[POINTS] == opened.counts[TRUTH] == 2


def test_convert_limit_restricts_the_number_of_frames(kitti, tmp_path):
    text = run_command("convert", kitti, "--out", tmp_path / "bag", "--limit", 1)
    assert "1 scans of 1" in text.replace("\n", "")
    with Bag(tmp_path / "bag") as opened:
        assert opened.counts[POINTS] == 1


def test_convert_skips_and_reports_broken_frames(tmp_path, monkeypatch, capsys):
    root = write_object_folder(tmp_path / "kitti", LABELS)
    broken_file = write_file(root / "training/velodyne/000000.bin", b"123")
    assert run_main(monkeypatch, "convert", root, "--out", tmp_path / "bag") == 1
    text = capsys.readouterr().out.replace("\n", "")
    assert "1 scans of 2" in text and str(broken_file) in text
    with Bag(tmp_path / "bag") as opened:
        assert opened.counts[POINTS] == 1


def test_convert_replaces_a_bag_only_with_force(kitti, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "300")
    out = tmp_path / "run [/final]"  # looks like rich markup
    command = ("convert", kitti, "--out", out, "--limit", 1)
    assert [
        run_main(monkeypatch, *command),
        run_main(monkeypatch, *command),
        run_main(monkeypatch, *command, "--force"),
        run_main(monkeypatch, "info", out),
    ] == [0, 2, 0, 0]
    assert capsys.readouterr().out.replace("\n", "").count("run [/final]") == 3


class Tty(io.StringIO):
    def isatty(self):
        return True


def test_info_folds_names_on_narrow_terminals_only(bag, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    with Bag(bag) as opened:
        topics, kinds = [*opened.topics], [*opened.topics.values()]
    text = run_command("info", bag)
    assert all(f"│ {topic} " in text for topic in topics) and str(bag) in text
    narrow = Terminal(file=Tty(), width=60, color_system=None)
    monkeypatch.setattr(info, "console", narrow)
    run_command("info", bag)
    text = narrow.file.getvalue()
    columns = [[cell.strip() for cell in line.split("│")[1:3]] for line in text.splitlines() if line.startswith("│")]
    assert "…" not in text and max(map(len, text.splitlines())) <= 60
    for names, cells in zip((topics, kinds), zip(*columns)):
        assert all(name in "".join(cells) for name in names)


@pytest.mark.parametrize("wide", [False, True])
def test_piped_table_is_never_truncated(wide, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    table = make_table(
        "a title that is wider than its table" * (1 + 20 * wide), "", "score", "another" * (1 + 30 * wide)
    )
    table.add_row("a name of a detector", "100.0", "200.0")
    pipe = Terminal(file=io.StringIO())
    pipe.print(table)
    title, *rows = pipe.file.getvalue().splitlines()
    assert title == table.title
    assert rows[-2].split() == "a name of a detector 100.0 200.0".split()


def test_info_json_has_the_content_of_the_table(bag, kitti):
    content = json.loads(run_command("info", "--json", bag))
    with Bag(bag) as opened:
        assert {row["topic"]: (row["type"], row["messages"]) for row in content["topics"]} == {
            topic: (kind, opened.counts[topic]) for topic, kind in opened.topics.items()
        }
    assert content["seconds"] == pytest.approx(0.1)
    folder = json.loads(run_command("info", kitti, "--json"))
    assert (folder["frames"], folder["layout"]) == (2, "KITTI object data")
    assert folder["first_cloud"]["labels"] == ["Pedestrian"]


def test_bag_problem_is_reported_and_command_continues(bag, tmp_path):
    shutil.copytree(bag, tmp_path / "bag")
    text = (bag / "metadata.yaml").read_text().replace("message_count: 2", "message_count: 9")
    (tmp_path / "bag/metadata.yaml").write_text(text)
    for command in (["info", tmp_path / "bag"], ["convert", tmp_path / "bag", "--out", tmp_path / "out"]):
        result = CliRunner().invoke(cli, [*map(str, command)], catch_exceptions=False)
        assert result.exit_code == 0
        (warned,) = [line for line in result.stderr.splitlines() if "warning" in line]
        assert warned.startswith(f"warning: {tmp_path}/bag/metadata.yaml does not match the bag: it declares 9")


def test_info_lists_topics_that_are_not_read(tmp_path):
    with open(tmp_path / "a.mcap", "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2")
        for name, encoding in (("Log", "protobuf"), ("Text", "cdr")):
            writer.register_channel(f"/{name}", encoding, writer.register_schema(name, "", b""))
        writer.finish()
    assert "Log as protobuf, not read" in run_command("info", tmp_path / "a.mcap")
    content = json.loads(run_command("info", tmp_path / "a.mcap", "--json"))
    assert [row["topic"] for row in content["unreadable"]] == ["/Log"]


def test_info_describes_a_recording_that_is_not_a_bag(kitti):
    text = run_command("info", kitti)
    assert f"{kitti}: KITTI object data, 2 frames, a camera, labelled boxes" in text
    assert "10 Hz assumed" in text and "first cloud: 000000, " in text and "labels of the first cloud: " in text


def test_info_shows_topics_types_counts_and_length(bag):
    text = run_command("info", bag)
    rows = {line.split("│")[1].strip(): line for line in text.splitlines() if "│ /" in line}
    with Bag(bag) as opened:
        assert {*rows} == {*opened.topics}
        for topic, kind in opened.topics.items():
            assert kind in rows[topic] and f" {opened.counts[topic]} " in rows[topic]
    assert "reliable, transient_local" in rows["/tf_static"]
    assert "reliable, volatile" in rows[POINTS]
    assert "0.1 s" in text


def test_evaluate_scores_both_pedestrians(kitti, tmp_path):
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
        assert all(content[s]["all"][count] == sum(content[s][r][count] for r in RANGES) for s in STAGES)
    assert content["final"]["0-15"]["recall"] == 1  # the seed is the pedestrian itself
    assert content["final"]["0-15"]["centre_error_m"] < WALKER[3]
    assert content["ms"]["total"] > 0 and all(ms >= 0 for ms in content["ms"].values())


def test_converted_bag_scores_like_its_folder(kitti, bag, tmp_path):
    assert drop_times(evaluate(tmp_path, "--data", bag)) == drop_times(evaluate(tmp_path, "--data", kitti))


def test_evaluate_prints_the_number_of_pedestrians(bag, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert "2 pedestrians in 2 frames" in run_command("evaluate", "candidates", "--data", bag)


@pytest.mark.parametrize(
    "words",
    [words for words, command in LEAVES if {"data", "data_option"} <= {p.name for p in command.params}],
    ids=" ".join,
)
def test_data_argument_and_data_option_are_equivalent(words, tmp_path, monkeypatch, capsys):
    needs_out = "detect", "setup", "train", "seed"
    out = ("--out", tmp_path / "out") if words[0] in needs_out else ()
    results = ("--results", tmp_path / "r.json") if words[-1] == "nuscenes" else ()
    outputs = {}
    for name, value in {
        "argument": ["none"],
        "option": ["--data", "none"],
        "both": ["none", "--data", "none"],
        "neither": [],
    }.items():
        if name == "neither" and words[0] in ("demo", "view"):
            continue
        assert run_main(monkeypatch, *words, *value, *out, *results) == 2
        outputs[name] = capsys.readouterr().err.splitlines()[-1]
    assert outputs["argument"] == outputs["option"] and "none does not exist" in outputs["argument"]
    assert "expected one DATA" in outputs["both"]
    assert "DATA is missing" in outputs.get("neither", "DATA is missing")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["kitti", "KITTI", "kitti-object", "kitti_object"])
def test_format_names_are_accepted_in_any_spelling(kitti, tmp_path, name):
    run_command("convert", "--data", kitti, "--to", name, "--limit", 1, "--out", tmp_path / "k")
    assert (tmp_path / "k/training/velodyne").is_dir()
    run_command("simulate", "--to", name, "--frames", 1, "--out", tmp_path / "s")
    assert (tmp_path / "s/training/velodyne").is_dir()


def test_cloud_without_core_points_has_no_candidates(bag, tmp_path):
    content = evaluate(tmp_path, "--data", bag, *make_set_options("clustering.dbscan.min_samples=100000"))
    for stage in STAGES:
        row = content[stage]["all"]
        assert (row["tp"], row["fp"], row["fn"], row["f1"]) == (0, 0, 2, 0)
        assert row["centre_error_m"] is None


def test_frame_that_cannot_be_read_is_counted_as_skipped(kitti, tmp_path):
    root = write_object_folder(tmp_path / "kitti", make_walker_label(), count=3)
    write_file(root / "training/velodyne/000001.bin", b"123")
    content = evaluate(tmp_path, "--data", root)
    assert content["frames"] == 2
    (line,) = content["skipped"]
    assert "000001.bin" in line


@pytest.mark.no_cover
def test_real_scans_score_the_same_from_folder_and_bag(data, tmp_path):
    root = data / "kitti_object"
    run_command("convert", root, "--out", tmp_path / "bag", "--limit", 6)
    content = evaluate(tmp_path, "--data", tmp_path / "bag")
    labels = [path.read_text() for path in sorted(root.glob("training/label_2/*.txt"))[:6]]
    counts = [sum(line.startswith("Pedestrian ") for line in text.splitlines()) for text in labels]
    assert content["frames"] == sum(n > 0 for n in counts)
    assert content["ground_truth"] == sum(counts)


@pytest.mark.parametrize("command", [["demo"], ["run", "perception"]])
def test_missing_rclpy_is_reported_before_any_work(command, tmp_path):
    write_file(tmp_path / "rclpy/__init__.py", "raise ImportError('not for this Python')")
    end = subprocess.run(
        [sys.executable, "-m", "lidar_perception.cli.main", *command],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])},
    )
    assert end.returncode == 2
    assert (
        end.stderr.strip()
        .splitlines()[-1]
        .endswith("cannot load rclpy (not for this Python): source ROS 2 Jazzy, or pip install 'lidar_perception[ros]'")
    )
    assert not (tmp_path / "out").exists()


def test_demo_passes_the_measured_sensor_height_to_its_nodes(tmp_path):
    write_bag(tmp_path / "bag", [make_lowered_crowd(i, 1.0) for i in range(3)])
    recording = open_and_describe(tmp_path / "bag")
    played = _open_replayed_bag(recording.path, recording)
    pose = _load_node_params(DetectorChoice("candidates"), played).ground.sensor_pose
    assert pose.height == pytest.approx(0.7, abs=0.02)
