"""The campaign in its short form, and its own laws: the same seed gives the same cases, and what is
broken is found, kept and replayed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from samples import wait_for_the_end

from lidar_perception.campaign import files, mutation, shapes
from lidar_perception.campaign.case import FAILED, REFUSED, SURVIVED, Case, Outcome, generator
from lidar_perception.campaign.command import Said
from lidar_perception.campaign.good import CLOUD, good, mutated
from lidar_perception.campaign.run import PARTS, Tally, kind_of, replay, run_campaign
from lidar_perception.campaign.worker import Limits
from lidar_perception.cli.campaign import campaign
from lidar_perception.data.bag import Bag
from lidar_perception.data.kitti.folder import read_velodyne
from lidar_perception.data.open import open_recording
from lidar_perception.types import InputError
from lidar_perception.wire.codec import decode
from msg_utils.point_cloud2 import to_array

PLANTED = '''
"""A part of the campaign in which every third case breaks, each in another way."""
import os, sys, time
from lidar_perception.campaign.case import SURVIVED, Case, Outcome

def case_of(seed, number):
    return Case("planted", f"case {number}", seed, number, {"how": number % 18}, bytes([number]))

class Attempt:
    def __init__(self, folder):
        pass
    def __call__(self, case):
        if case.settings["how"] == 3:
            raise ValueError(f"planted {case.data[0]}")
        if case.settings["how"] == 6:
            os.kill(os.getpid(), 9)
        if case.settings["how"] == 9:
            time.sleep(600)
        if case.settings["how"] == 12:
            self.held = bytearray(300 * 2**20)
            del self.held
        if case.settings["how"] == 15:
            sys.exit("gone")
        return Outcome(SURVIVED)
'''

LONG_CASE = """
import sys, time
from pathlib import Path
from lidar_perception.campaign.case import Case
from lidar_perception.campaign.worker import Limits, Worker
worker = Worker("planted", Limits(600, 0), Path(sys.argv[1]))
worker.start()
worker.connection.send(("case", Case("planted", "long", 0, 9, {"how": 9})))
print(worker.process.pid, flush=True)
time.sleep(600)
"""


@pytest.fixture
def planted(tmp_path, monkeypatch):
    """A part whose faults are known, in a package that the campaign's own is continued by."""
    from lidar_perception import campaign as package
    (tmp_path / "more").mkdir()
    (tmp_path / "more/planted.py").write_text(PLANTED)
    (tmp_path / "more/sitecustomize.py").write_text(
        "import lidar_perception.campaign as c\n"
        f"c.__path__.append({str(tmp_path / 'more')!r})\n")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path / "more"), *sys.path]))
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path / "more")])
    monkeypatch.setitem(PARTS, "planted", (1, Limits(5.0, 200.0), "planted faults"))


def test_planted_faults_are_found_kept_and_replayed(planted, tmp_path):
    tally, = run_campaign(tmp_path / "out", 5.0, 7, ["planted"], 18)
    assert tally.tried == 18 and tally.verdicts == {SURVIVED: 13, FAILED: 5}
    numbers = sorted(int(path.stem.rpartition("-")[2]) for path in tally.files)
    assert numbers == [3, 6, 9, 12, 15] and tally.failed()
    said = {}
    for path in tally.files:
        case, outcome = replay(path, tmp_path / "again")
        assert outcome.verdict == FAILED and case.seed == 7
        assert json.loads(path.read_text())["reason"] == outcome.reason or "MB" in outcome.reason
        said[case.number] = outcome.reason
    assert "planted 3" in said[3] and "SIGKILL" in said[6] and "no end within" in said[9]
    assert "MB, more than 200" in said[12] and "exit code" in said[15]


def test_the_command_ends_with_1_if_anything_failed(planted, tmp_path, monkeypatch):
    only = next(option for option in campaign.params if option.name == "only")
    monkeypatch.setattr(only.type, "choices", ["planted"])
    def run(*words):
        return CliRunner().invoke(campaign, ["--out", str(tmp_path / "out"), *words])

    assert run("--only", "planted", "--cases", "3").exit_code == 0
    result = run("--only", "planted", "--cases", "4")
    assert result.exit_code == 1 and "--replay" in result.output.replace("\n", "")
    file, = (tmp_path / "out/failures").iterdir()
    again = run("--replay", str(file))
    assert again.exit_code == 1 and "planted 3" in again.output
    content = json.loads((tmp_path / "out/campaign.json").read_text())
    assert content["planted"]["tried"] == 4 and content["planted"][FAILED] == 1

    def stopped(*_):
        signal.raise_signal(signal.SIGTERM)
    monkeypatch.setattr(Tally, "add", stopped)
    result = run("--only", "planted", "--cases", "3")
    assert result.exit_code == 130 and "interrupted" in result.output


def test_a_part_ends_when_its_campaign_is_killed(planted, tmp_path):
    command = subprocess.Popen([sys.executable, "-c", LONG_CASE, str(tmp_path)], text=True,
                               stdout=subprocess.PIPE)
    assert command.stdout is not None
    part = int(command.stdout.readline())
    command.kill()
    command.wait()
    wait_for_the_end(part)


def test_a_part_that_cannot_start_is_a_failure_with_a_reason(tmp_path, monkeypatch):
    monkeypatch.setitem(PARTS, "nowhere", (1, Limits(1.0, 1.0), ""))
    tally, = run_campaign(tmp_path, 1.0, 1, ["nowhere"], 1)
    assert tally.failed() and "nowhere" in tally.problem
    with pytest.raises(InputError, match="there is no part 'elsewhere'"):
        run_campaign(tmp_path, 1.0, 1, ["elsewhere"], 1)


def test_parts_that_need_ros_say_so_where_there_is_none(planted, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    messages, other = run_campaign(tmp_path / "out", 2, 1, ["messages", "planted"], 1)
    assert "source ROS 2 Jazzy" in messages.problem and messages.tried == 0 and messages.failed()
    assert other.tried == 1 and not other.failed()


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"part": 1}', "[" * 10**5])
def test_what_holds_no_case_is_named(content, tmp_path):
    (tmp_path / "file.json").write_text(content)
    with pytest.raises(InputError, match="holds no case"):
        replay(tmp_path / "file.json", tmp_path)


def test_a_case_comes_back_from_its_file(tmp_path):
    case = Case("messages", "a name", 3, 4, {"a": [1, None]}, bytes(range(256)))
    case.save(tmp_path / "case.json", Outcome(FAILED, "why"))
    assert Case.load(tmp_path / "case.json") == case


def messages_of(seed, count):
    """In this process no node is made: cases are values."""
    messages = pytest.importorskip("lidar_perception.campaign.messages", reason="needs ROS 2",
                                   exc_type=ImportError)
    return [messages.case_of(seed, i) for i in range(count)]


@pytest.mark.no_cover
def test_the_same_seed_gives_the_same_cases_and_another_one_others(monkeypatch):
    # What the sound files hold does not matter here, and to write them takes seconds.
    monkeypatch.setattr(files, "sound", lambda name: {f"{name}/{i}.bin": bytes(99) for i in "ab"})
    for cases in (messages_of, lambda seed, n: [files.case_of(seed, i) for i in range(n)],
                  lambda seed, n: [shapes.case_of(seed, i) for i in range(n)]):
        assert cases(5, 30) == cases(5, 30)
        one, other = ([(case.settings, case.data) for case in cases(seed, 30)] for seed in (5, 6))
        assert one != other
    assert shapes.case_of(1, len(shapes.CASES)) is None
    assert {shapes.case_of(1, i).name for i in range(len(shapes.CASES))} == {
        shapes.case_of(2, i).name for i in range(len(shapes.CASES))}  # only the order is drawn


@pytest.mark.parametrize("seed", range(40))
def test_mutations_change_something_and_leave_what_they_got(seed):
    data = good(CLOUD)
    _, what = mutation.mutate_bytes(data, np.random.default_rng(seed))
    assert what and data == good(CLOUD)
    text, what = mutation.mutate_text("a: 1\nb: [2.5, x]\n", np.random.default_rng(seed))
    assert what and isinstance(text, str)
    message, what = mutated(CLOUD, np.random.default_rng(seed))
    assert what and message != data


def test_good_messages_are_good_and_most_mutated_ones_can_be_decoded():
    assert len(to_array(decode(good(CLOUD), CLOUD))) > 500
    for i in range(200):
        decode(mutated(CLOUD, generator("test", 0, i))[0], CLOUD)


def test_the_law_of_commands():
    def verdict(code, out="", errors=""):
        return Said(code, out, errors, 100.0).outcome(1000.0).verdict

    assert verdict(0) == SURVIVED
    assert verdict(2, errors="KITTI, 3 frames\nError: cannot read it; do that\n") == REFUSED
    assert verdict(1, out="left out: a frame\n") == REFUSED
    assert verdict(2, errors="something\n") == verdict(2) == verdict(1) == FAILED
    assert verdict(None) == verdict(-11) == verdict(70) == FAILED
    for code in (0, 1, 2):
        assert verdict(code, errors="Traceback (most recent call last):\n\nError: x") == FAILED
    assert Said(0, "", "", 2000.0).outcome(1000.0).verdict == FAILED


def test_failures_of_one_kind_are_counted_as_one():
    assert kind_of("/a/b.json: field 'x' at 17 of 1.5e3") == kind_of("/c: field 'yz' at 4 of 2")
    tally = Tally("files")
    for i in range(9):
        tally.add(Outcome(FAILED, f"took {i} MB"))
    assert list(tally.reasons.values()) == [9]


def test_time_and_memory_that_grow_too_fast_are_failures():
    case = shapes.case_of(1, 0)
    judged = shapes._judged
    n = shapes.TIMES * 50_000
    case = Case("shapes", "", 1, 0, {"stage": "clusters dbscan", "arrangement": "a line"})
    assert judged(case, [(1.0, 100.0), (4.6, 460.0)], n).verdict == SURVIVED
    assert judged(case, [(1.0, 100.0), (16.0, 400.0)], n).verdict == FAILED
    assert judged(case, [(1.0, 50.0), (4.0, 800.0)], n).verdict == FAILED
    assert judged(case, [(9.0, 9000.0)], n).verdict == FAILED


# The short form. Worker processes do what a long run does, with seeds that stay.
@pytest.mark.parametrize("part, cases", [
    ("messages", 60), pytest.param("files", 16, marks=pytest.mark.no_cover),
    pytest.param("shapes", 8, marks=pytest.mark.no_cover)])
def test_the_short_campaign_finds_nothing(part, cases, tmp_path):
    if part == "messages":
        pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")
    tally, = run_campaign(tmp_path, 10.0, 1, [part], cases)
    assert not tally.failed(), (tally.problem, tally.reasons, [
        json.loads(path.read_text())["name"] for path in tally.files])
    assert tally.tried == cases and tally.verdicts[SURVIVED] >= cases // 10


@pytest.mark.parametrize("instead", files.INSTEAD)
def test_a_file_is_replaced_also_where_its_folder_is_made_with_it(instead, tmp_path):
    files._replace(tmp_path / "onnx/weights.onnx", instead, b"")
    assert os.path.lexists(tmp_path / "onnx/weights.onnx") == (instead != "nothing")


def test_a_pipe_in_the_place_of_a_file_is_refused_and_not_waited_for(tmp_path):
    (tmp_path / "bag").mkdir()
    for path in ("bag/bag.mcap", "pipe.bin"):
        os.mkfifo(tmp_path / path)
    for read in (lambda: open_recording(tmp_path / "bag"), lambda: Bag(tmp_path / "bag/bag.mcap"),
                 lambda: read_velodyne(tmp_path / "pipe.bin")):
        with pytest.raises(InputError, match="is no file"):
            read()
