"""Training of an experiment's detectors: one plan for all, resumable, each trained once."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from click.testing import CliRunner
from samples import make_walker_label, write_file, write_object_folder

from experiments.__main__ import cli
from experiments.framework import command, trained_models
from experiments.framework.experiment import Cell, Experiment, Section, Table
from experiments.framework.scenes import ExperimentScenes
from experiments.framework.trained_models import Model, ModelRequest, plan_training, train_models
from lidar_perception.detectors.checkpoint import read_header
from lidar_perception.param_fields import with_values
from lidar_perception.training.params import PointPillarsTraining
from lidar_perception.types import InputError

pytestmark = [pytest.mark.no_cover, pytest.mark.usefixtures("one_thread", "streets", "tiny_size")]
TINY = {
    "sensor": "generic:16,-20,5,2,10",
    "data.scans": 4,
    "data.val_scans": 1,
    "steps": 2,
    "batch": 1,
    "ahead": 10.0,
    "aside": 10.0,
    "augment.crowded": 0.0,
}


def choose_models(params, seed):
    return [
        Model(f"v0 seed {seed}", with_values(params, {"version": "v0", "seed": seed})),
        Model(f"v0 half seed {seed}", with_values(params, {"version": "v0", "seed": seed}), 0.5, required=False),
    ]


def count_weights(frames, number, models):
    """Record the weights that a frame is measured with."""
    return {
        "frame": frames[number].name,
        "points": len(frames[number].load()),
        "weights": [str(model.weights) for model in models.values()],
    }


def list_models(records, models):
    rows = tuple((name, Cell(model.steps), Cell(model.scenes)) for name, model in models.items())
    return [Section("Models", "", (Table("models", "Models", ("name", "steps", "scenes"), rows),))]


TRAINED = Experiment(
    "trained", "Trained", "How?", count_weights, list_models, training=PointPillarsTraining(), models=choose_models
)


def make_request(out: Path, **changes) -> ModelRequest:
    params = with_values(PointPillarsTraining(), {**TINY, **changes.pop("params", {})})
    return ModelRequest(choose_models, params, ExperimentScenes("sim"), out, **{"test_frames": 2, **changes})


def test_models_share_one_plan_and_are_trained_once(tmp_path, monkeypatch):
    request = make_request(tmp_path, seeds=2)
    plan = plan_training(request)
    assert plan.values["steps"] == 2 and plan.seeds == 2
    trained = train_models(request, plan)
    assert [*trained] == ["v0 seed 0", "v0 half seed 0", "v0 seed 1", "v0 half seed 1"]
    assert [model.scenes for model in trained.values()] == [4, 2, 4, 2]
    assert {model.steps for model in trained.values()} == {2}
    assert {model.parameters for model in trained.values()} != {0}
    seeds = [read_header(model.weights).training["seed"] for model in trained.values()]
    assert seeds == [0, 0, 1, 1]
    scans = {path: path.stat().st_mtime_ns for path in (tmp_path / "scans").glob("*.npz")}
    assert len(scans) == 4 + 1  # simulated once for all models

    monkeypatch.setattr(trained_models, "_train", None)
    monkeypatch.setattr(trained_models, "_make_plan", None)
    assert train_models(request, plan_training(request)) == trained
    other = make_request(tmp_path, seeds=2, params={"lr": 0.001})
    with pytest.raises(TypeError):  # other settings need a new plan
        plan_training(other)


def test_optional_models_are_left_out_when_the_budget_is_spent(tmp_path, capsys):
    request = make_request(tmp_path, budget=1e-9, seeds=2)
    trained = train_models(request, plan_training(request))
    assert [*trained] == ["v0 seed 0"]
    assert "v0 half seed 0 is skipped" in capsys.readouterr().err


@pytest.mark.parametrize("least, planned", [(1, ["v0 seed 0", "v0 half seed 0"]), (10**9, ["v0 seed 0"])])
def test_plan_leaves_out_optional_models_for_more_steps(tmp_path, monkeypatch, least, planned):
    monkeypatch.setattr(trained_models, "MIN_MODEL_STEPS", least)
    plan = plan_training(make_request(tmp_path, budget=0.05, seeds=1, params={"steps": 0}))
    assert [*plan.durations] == [*plan.speeds] == planned


def test_too_short_budget_is_rejected_with_a_suggestion(tmp_path):
    with pytest.raises(InputError, match=r"too short for 20 steps.*--budget"):
        plan_training(make_request(tmp_path, budget=1e-4, params={"steps": 0}))


def test_stopped_training_resumes(tmp_path, monkeypatch):
    from lidar_perception.training.run import Run

    request, step = make_request(tmp_path, params={"save_steps": 1}), Run.step
    plan = plan_training(request)

    def stop(run, batch):
        signal.raise_signal(signal.SIGINT)
        return step(run, batch)

    with monkeypatch.context() as patch:
        patch.setattr(Run, "step", stop)
        with pytest.raises(KeyboardInterrupt):
            train_models(request, plan)
    steps = []
    monkeypatch.setattr(Run, "step", lambda run, batch: steps.append(1) or step(run, batch))
    assert len(train_models(request, plan)) == 2
    assert len(steps) == 3  # of 2 x 2; one was finished before


def run(*arguments):
    sets = [word for name, value in TINY.items() for word in ("--set", f"{name}={value}")]
    return CliRunner().invoke(cli, ["reproduce", "trained", *map(str, arguments), "--jobs", "1", *sets])


@pytest.fixture
def listed_models(monkeypatch):
    monkeypatch.setitem(command.EXPERIMENTS, "trained", f"{__name__}:TRAINED")


def test_command_trains_and_measures_on_other_scans(tmp_path, listed_models):
    result = run("sim", "--out", tmp_path / "out", "--limit", 2)
    assert result.exit_code == 0, result.output
    assert "v0 half seed 0" in (tmp_path / "out/report.md").read_text()
    assert "2 measured" in (tmp_path / "out/report.html").read_text()
    before = (tmp_path / "out/frames.jsonl").read_text()
    assert run("sim", "--out", tmp_path / "out", "--limit", 2, "--force").exit_code == 0
    assert (tmp_path / "out/frames.jsonl").read_text() == before
    assert len([*(tmp_path / "out/models").glob("*/")]) == 2


def test_frames_of_a_recording_are_used_once(tmp_path, listed_models):
    folder = write_object_folder(tmp_path / "kitti", make_walker_label(), count=6)
    scenes = ExperimentScenes.split(str(folder))
    all_frames = [*scenes.train, *scenes.val, *scenes.test]
    assert sorted(all_frames) == [f"{i:06}" for i in range(6)]
    assert [len(scenes.select_labelled(share)) for share in (1.0, 0.5, 0.01)] == [4, 2, 1]
    assert {*scenes.select_labelled(0.5)} < {*scenes.train}
    split_scenes = ExperimentScenes.split(str(folder), write_file(tmp_path / "test.txt", "000001\n000003\n"))
    assert split_scenes.test == ("000001", "000003")
    result = run(folder, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out/models/train-50.txt").read_text().split() == [*scenes.select_labelled(0.5)]


@pytest.mark.parametrize("option", [("--budget", "1"), ("--seeds", "2"), ("--set", "steps=1")])
def test_training_options_are_rejected_without_training(tmp_path, option):
    result = CliRunner().invoke(cli, ["reproduce", "stm-cpa", "sim", "--out", str(tmp_path / "o"), *option])
    assert result.exit_code == 2 and "trains none" in result.output
