"""Laws of adapting: what is learned from, what a kill changes, and when a round is not taken."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from adapting_samples import drive
from click.testing import CliRunner
from detection_samples import BOXES, lively, tiny, two_objects
from samples import write

from lidar_perception.adapting import adapt as adapt_module
from lidar_perception.adapting.adapt import LAST, Adapting, counted
from lidar_perception.adapting.drives import FEWEST
from lidar_perception.adapting.judging import IGNORED, KEPT, REJECTED, STATES
from lidar_perception.adapting.labels import ConcludedLabels
from lidar_perception.adapting.looking import SOURCES, FrameLook
from lidar_perception.adapting.params import BEST, HEARD, LABELS, MADE, RECORD, REPORT, AdaptParams
from lidar_perception.adapting.scenes import AdaptedScenes, save_labels
from lidar_perception.classes import CAR, DONT_CARE
from lidar_perception.cli.main import cli
from lidar_perception.data.frame import Frame
from lidar_perception.data.open import open_recording
from lidar_perception.data.to_bag import write_bag
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.detectors.open import open_detector
from lidar_perception.detectors.pointnet.detector import PointNetDetector
from lidar_perception.detectors.pointnet.params import PointNetParams
from lidar_perception.detectors.pointnet.weights_file import weights_file
from lidar_perception.detectors.pointpillars.anchors import anchor_classes, make_anchors
from lidar_perception.detectors.pointpillars.losses import detection_loss
from lidar_perception.detectors.pointpillars.network import Outputs
from lidar_perception.detectors.pointpillars.targets import dense
from lidar_perception.labeling.exchange import import_labels
from lidar_perception.runs.files import refuse_others
from lidar_perception.runs.resuming import locked
from lidar_perception.training.augment import TrainingScene
from lidar_perception.training.cache import write_arrays
from lidar_perception.training.out import STATE
from lidar_perception.training.params import AugmentParams
from lidar_perception.training.plan import TooShort
from lidar_perception.training.pointpillars.task import Preparation
from lidar_perception.types import CLASSES, PEDESTRIAN, Detections, InputError, LidarFrame

SENSOR = "generic:16,-14,3,2,10"
SMALL = AdaptParams(rounds=1, steps=3, batch=1, frames=100, scans=2, val_scans=1, sensor=SENSOR)
STILL = AugmentParams(crowded=0.0, object_turn=0.0, object_shift=0.0, flip=0.0, turn=0.0, scale=0.0,
                      dropout=0.0, intensity=0.0, height=0.0, tilt=0.0, beam_noise=0.0,
                      range_noise=0.0)
pytestmark = pytest.mark.usefixtures("one_thread_for_all", "streets")


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    """A simulated drive of the fewest frames, with poses."""
    path = tmp_path_factory.mktemp("drive") / "bag"
    made = CliRunner().invoke(cli, ["simulate", "--out", str(path), "--frames", str(FEWEST),
                                    "--seed", "3", "--sensor", SENSOR, "--people", "3"])
    assert made.exit_code == 0, made.exception
    return path


@pytest.fixture(scope="module")
def weights(tmp_path_factory) -> Path:
    """Of a small network that has learned nothing."""
    path = tmp_path_factory.mktemp("weights") / "old.safetensors"
    save_checkpoint(path, lively(tiny()), Header(tiny()))
    return path


def perfect_looks(bag: Path, out: Path) -> None:
    """Put into out, as the first looks, what a perfect detector would have seen."""
    for n, frame in enumerate(open_recording(bag)):
        truth = frame.truth()
        own = np.isin(truth.class_ids, [CAR, PEDESTRIAN, CLASSES.index("Cyclist")])
        found = Detections.of(truth.boxes[own], truth.class_ids[own], 0.95)
        found = Detections(found.boxes, found.class_ids, found.scores,
                           dict.fromkeys(SOURCES, found.scores))
        look = FrameLook(found, np.full(len(found), 50), np.full(len(found), 1.7), frame.pose())
        write_arrays(out / "round1" / "looks" / f"{n:06}.npz", look.arrays())


def adapted(bag: Path, weights: Path, out: Path, params: AdaptParams = SMALL) -> Adapting:
    run = Adapting(bag, weights, out, 1.0, params, "cpu", 0)
    run.run()
    return run


def tensors(path: Path) -> bytes:
    """All but the header, which says how long it took."""
    content = path.read_bytes()
    return content[8 + int.from_bytes(content[:8], "little"):]


@pytest.fixture(scope="module")
def whole(bag, weights, tmp_path_factory) -> Path:
    """The folder of a run that nothing has stopped."""
    out = tmp_path_factory.mktemp("whole") / "out"
    perfect_looks(bag, out)
    adapted(bag, weights, out)
    return out


@pytest.mark.no_cover
def test_a_killed_run_ends_as_if_it_had_not_been(bag, weights, whole, tmp_path):
    out = tmp_path / "out"
    perfect_looks(bag, out)
    process = multiprocessing.get_context("fork").Process(target=adapted, args=(bag, weights, out))
    process.start()
    end = time.monotonic() + 240
    while not (out / "round1" / "objects.npz").exists():
        assert process.is_alive(), f"it ended with code {process.exitcode}"
        assert time.monotonic() < end
        time.sleep(0.002)
    process.kill()
    process.join()
    assert not (out / BEST).exists()
    before = weights.read_bytes()
    run = adapted(bag, weights, out)
    assert weights.read_bytes() == before
    assert tensors(out / "round1" / LAST) == tensors(whole / "round1" / LAST)
    for name in ("round1/labels.npz", "round1/judged.json", "judged.json"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()
    assert (out / BEST).read_bytes() == run.best.read_bytes()


def test_other_settings_are_no_resumed_run(bag, weights, whole):
    with pytest.raises(InputError, match="seed 0, not 1"):
        adapted(bag, weights, whole, replace(SMALL, seed=1))


def test_a_recording_that_has_grown_since_is_no_resumed_run(bag, weights, whole, monkeypatch):
    monkeypatch.setattr(adapt_module, "frames_of", lambda recording: recording.frames[:-1])
    with pytest.raises(InputError, match=f"{whole} holds a run with frame_names"):
        adapted(bag, weights, whole)


def test_a_budget_that_is_spent_before_the_first_step_is_said(bag, weights, whole, tmp_path,
                                                              monkeypatch):
    out, asked = tmp_path / "out", Adapting._training
    shutil.copytree(whole, out)
    (out / "round1" / LAST).unlink()
    (out / "round1" / STATE).unlink()
    monkeypatch.setattr(Adapting, "_training", lambda run, folder, hours=None: asked(
        run, folder, 1e-9 if folder.name == "round1" else None))
    with pytest.raises(InputError, match=r"spent before the first step.*--resume"):
        adapted(bag, weights, out)
    monkeypatch.undo()
    assert tensors(adapted(bag, weights, out).best) == tensors(whole / BEST)


@pytest.mark.parametrize("record", ["{}", "[]", '{"asked": {"da', '{"asked": [], "frames": 9}',
                                    '{"asked": {}, "frames": null}'])
def test_a_record_that_is_none_is_no_resumed_run(bag, weights, tmp_path, record):
    write(tmp_path / RECORD, record)
    with pytest.raises(InputError, match=rf"cannot read \S*{RECORD}.*--force"):
        adapted(bag, weights, tmp_path)


def test_a_round_that_makes_simulated_validation_worse_is_not_taken(bag, weights, whole, tmp_path,
                                                                    monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(whole, out)
    for name in ("judged.json", "round1/judged.json"):
        (out / name).unlink()
    scores = iter([{"score": 50.0}, {"score": 40.0}])
    monkeypatch.setattr(adapt_module, "simulated_score", lambda *_: next(scores))
    opened, really = [], adapt_module.opened_with
    monkeypatch.setattr(adapt_module, "opened_with", lambda weights, header, device: (
        opened.append(weights) or really(weights, header, device)))
    run = adapted(bag, weights, out)
    assert opened == [weights, out / "round1" / LAST]  # each once, whoever looks with them
    assert "simulated AP fell from 50.0 to 40.0" in run.rounds[0].refused
    assert (out / BEST).read_bytes() == weights.read_bytes()
    assert json.loads((out / "adapt.json").read_text())["rounds"][0]["refused"]


def test_the_cluster_network_is_adapted_in_the_same_way(bag, whole, tmp_path):
    old, out = weights_file(PointNetParams()), tmp_path / "out"
    perfect_looks(bag, out)
    shutil.copy(whole / HEARD, out)
    shutil.copytree(whole / "scans", out / "scans")
    run = adapted(bag, old, out, replace(SMALL, steps=1, worse_simulated=100.0,
                                         worse_agreement=1.0))
    assert isinstance(open_detector(out / BEST, "cpu"), PointNetDetector)
    assert run.best != old and tensors(out / BEST) != tensors(old)
    assert (run.low < 0).all()  # it sees all around, and so does all that is learned


def test_report_and_labels_say_what_was_kept(bag, weights, whole):
    from lidar_perception.adapting.report import write_report
    run = adapted(bag, weights, whole)
    write_report(run)
    frames = list(open_recording(bag))
    labels = import_labels(whole / LABELS, "openlabel", frames)
    assert labels.boxes == sum(own.of(KEPT).sum() for own in run.seen[0].labels) > 0
    refuse_others(whole, MADE)  # --force replaces all of it
    page = (whole / REPORT).read_text()
    assert page.count("<img") == 6 and all(v.reason in page.replace("&#39;", "'")
                                           for v in run.seen[0].verdicts)


# what is learned from

def labelled(states: list[str]) -> ConcludedLabels:
    return ConcludedLabels(BOXES.numpy().astype(np.float64), np.array([CAR, PEDESTRIAN]),
                           np.array([STATES.index(s) for s in states]), np.arange(2), np.ones(2),
                           np.ones(2, bool))


def test_scenes_are_the_clouds_with_kept_boxes_and_regions(bag, tmp_path):
    path = tmp_path / "labels.npz"
    save_labels(path, [4, 2], [labelled([KEPT, IGNORED]), labelled([REJECTED, KEPT])])
    scenes = AdaptedScenes(bag, path, (0.0, -20.0), (30.0, 20.0), 1.5)
    assert len(scenes) == 2 and scenes.key(0) != scenes.key(1)
    first, second = scenes.scene(0), scenes.scene(1)
    assert first.class_ids.tolist() == [CAR, DONT_CARE] and first.wanted.tolist() == [True, False]
    assert second.class_ids.tolist() == [PEDESTRIAN] and second.height == 1.5
    cloud = list(open_recording(bag))[4].load()
    inside = ((cloud.xyz[:, :2] >= [0, -20]) & (cloud.xyz[:, :2] < [30, 20])).all(axis=1)
    np.testing.assert_array_equal(first.points[:, :3], cloud.xyz[inside])


def test_regions_give_no_gradient_and_change_none_elsewhere():
    config = tiny()
    anchors, kinds = make_anchors(config), anchor_classes(config)
    boxes = BOXES.numpy().astype(np.float64)

    def gradient(class_ids: list[int]) -> torch.Tensor:
        scene = TrainingScene(two_objects(), boxes, np.array(class_ids), np.ones(2, bool))
        sample = Preparation(config, STILL)(scene, np.random.default_rng(0))
        torch.manual_seed(1)
        outputs = Outputs(*(torch.randn(1, len(anchors), n, requires_grad=True)
                            for n in (len(config.classes), 7, 2)))
        targets = dense([sample.targets], len(anchors), torch.device("cpu"))
        detection_loss(outputs, targets, kinds).total.backward()
        return torch.cat([part.grad.flatten(2) for part in outputs], dim=2)[0].abs().sum(dim=1)

    region, background = gradient([DONT_CARE, PEDESTRIAN]), gradient([CLASSES.index("Misc"),
                                                                      PEDESTRIAN])
    touching = (anchors[:, :2] - BOXES[0, :2]).abs().amax(dim=1) < 0.3
    assert {int(k) for k in kinds[touching]} == set(range(len(config.classes)))
    assert (region[touching] == 0).all() and (background[touching] > 0).all()
    assert ((region == background) | (region == 0)).all()


# bad input: one line, and nothing is made or replaced

def standing(path: Path, count: int = 16) -> Path:
    stamps, points = drive()[1][:count], two_objects()
    frames = [Frame.of(str(i), LidarFrame(points[:, :3], points[:, 3], stamps[i], "velodyne"),
                       pose=partial(np.eye, 4)) for i in range(count)]
    write_bag(path, frames)
    return path


def refused(out: Path, *words: str) -> str:
    said = CliRunner().invoke(cli, ["adapt", "--out", str(out), "--device", "cpu", "--jobs", "0",
                                    "--frames", "100", "--val-scans", "1", "--sensor", SENSOR,
                                    *map(str, words)])
    assert isinstance(said.exception, InputError), said.exception
    assert "\n" not in str(said.exception)
    return str(said.exception)


def test_bad_input_is_refused_in_one_line(bag, weights, tmp_path):
    out = tmp_path / "out"
    assert "5 frames" in refused(out, "--data", standing(tmp_path / "short", 5), "--weights",
                                 weights)
    assert "stands still" in refused(tmp_path / "still", "--data", standing(tmp_path / "bag"),
                                     "--weights", weights)
    assert "--budget" in refused(out, "--data", bag, "--weights", weights, "--budget", "0")
    other = write(tmp_path / "other.onnx", "no weights")
    assert "other.onnx" in refused(out, "--data", bag, "--weights", other)
    assert not out.exists()


def test_what_is_said_of_a_short_budget_is_said_of_the_whole(bag, weights, whole, tmp_path,
                                                             monkeypatch):
    def start(network, asked, params, own):
        raise TooShort(asked.budget, 4 * asked.budget)
    monkeypatch.setattr(adapt_module, "start", start)
    shutil.copytree(whole / "round1/looks", tmp_path / "round1/looks")
    with pytest.raises(InputError, match=r"a budget of 1 h .* give --budget 4 or more"):
        adapted(bag, weights, tmp_path, replace(SMALL, steps=0))


def test_a_folder_of_somebody_else_stays_as_it_is(bag, weights, tmp_path):
    file = write(tmp_path / "out" / "thesis.txt", "mine")
    for more in ((), ("--force",), ("--resume",)):
        assert "no run of adapt" in refused(tmp_path / "out", "--data", bag, "--weights", weights,
                                            *more)
    write(tmp_path / "out" / RECORD, "{}")
    assert "such as thesis.txt" in refused(tmp_path / "out", "--data", bag, "--weights", weights,
                                           "--force")
    assert sorted(p.name for p in file.parent.iterdir()) == [RECORD, "thesis.txt"]


def test_a_run_that_replaces_another_keeps_others_out_too(bag, weights, whole, tmp_path,
                                                         monkeypatch):
    out = tmp_path / "out"
    shutil.copytree(whole, out)

    def run(self) -> None:
        assert not any(out.iterdir())
        with locked(out):
            pass
    monkeypatch.setattr(Adapting, "run", run)
    assert "another process is writing" in refused(out, "--data", bag, "--weights", weights,
                                                   "--force")


def test_too_little_agreement_is_said_with_a_report(bag, weights, tmp_path):
    out = tmp_path / "out"
    line = refused(out, "--data", bag, "--weights", weights)
    assert "agree on" in line and "train --sensor" in line
    assert [p.name for p in out.iterdir()] == ["report.html"]
    page = (out / "report.html").read_text()
    again = "--data", standing(tmp_path / "bag"), "--weights", weights, "--mount-height", 1.2
    assert "stands still" in refused(out, *again)  # the same folder will do
    assert not out.exists()
    out.mkdir()
    assert "stands still" in refused(write(out / "report.html", page).parent, *again, "--resume")
    theirs = write(tmp_path / "theirs" / "report.html", "<title>Sales</title>")
    assert "no run of adapt" in refused(theirs.parent, *again)
    assert theirs.read_text() == "<title>Sales</title>"


def test_a_later_round_with_too_little_agreement_leaves_what_was_learned(bag, weights, whole,
                                                                         tmp_path):
    out, params = tmp_path / "out", replace(SMALL, rounds=2, worse_simulated=100.0,
                                            worse_agreement=1.0)
    shutil.copytree(whole / "round1", out / "round1")
    run = adapted(bag, weights, out, params)
    assert len(run.rounds) == 1 and not run.rounds[0].refused  # of a network that learned nothing
    assert (out / BEST).read_bytes() == (out / "round1" / LAST).read_bytes()
    assert counted(run.seen)[KEPT] == run.rounds[0].counts[KEPT]  # it is what is told and written
