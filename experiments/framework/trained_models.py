"""Training of all detectors of an experiment on the same scenes and within one time budget.

    plan = plan_training(request)           # measured once, then read from a file
    trained_models = train_models(request, plan)   # a finished model is not trained again

Every model has a folder out/models/NAME-HASH, where HASH is the hash of its configuration. An
interrupted run is resumed there.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from experiments.framework.scenes import TEST_SCANS, ExperimentScenes
from lidar_perception import __version__
from lidar_perception.param_fields import with_values
from lidar_perception.runs.files import read_text, write_text
from lidar_perception.runs.terminal import errors, format_duration
from lidar_perception.training.params import PointNetTraining, PointPillarsTraining
from lidar_perception.training.plan import Plan, Speed, estimate_training_durations, fit_plan
from lidar_perception.training.request import TrainingRequest
from lidar_perception.types import InputError

Training = PointPillarsTraining | PointNetTraining
DEFAULT_BUDGET_H = 2.0  # default training budget with simulated scans
MAX_SEEDS = 3
STEPS_PER_SEED = 4000  # if more steps per model fit into the budget, another seed is trained instead
MIN_MODEL_STEPS = 1000  # if fewer steps per model fit into the budget, optional models are left out
NORM_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")


@dataclass(frozen=True)
class Model:
    """A detector to train.

    Attributes:
        name: Unique name in the experiment, such as "v4, seed 1".
        params: Training parameters. The numbers of scenes and steps come from the common plan.
        label_share: Fraction of the labelled scenes to train on, above 0 and up to 1.
        required: True to train it even if the budget is short.
    """

    name: str
    params: Training
    label_share: float = 1.0
    required: bool = True


@dataclass(frozen=True)
class TrainedModel:
    """A trained detector.

    Attributes:
        weights: Checkpoint with the best validation score.
        steps, seconds: Duration of the training.
        best_step: Step of the checkpoint.
        scenes: Number of training scenes.
        parameters: Number of learned parameters.
    """

    model: Model
    weights: Path
    steps: int
    seconds: float
    best_step: int
    scenes: int
    parameters: int


@dataclass(frozen=True)
class ModelRequest:
    """Request to train the models of an experiment.

    Attributes:
        models: Function models(params, seed) that returns the models of a seed, the most important
            ones first.
        params: Training parameters of all models, including those set by the user.
        scenes: Scenes for training, validation and test.
        out: Folder of the experiment.
        budget: Time budget in hours for training and measuring. None: no limit; the parameters give
            the number of steps.
        seeds: Number of seeds. None: as many as get STEPS_PER_SEED steps each, up to MAX_SEEDS.
        test_frames: Number of frames to measure after the training.
    """

    models: Callable[[Any, int], Sequence[Model]]
    params: Training
    scenes: ExperimentScenes
    out: Path
    budget: float | None = None
    seeds: int | None = None
    device: str = "auto"
    jobs: int = 1
    test_frames: int = TEST_SCANS

    @property
    def folder(self) -> Path:
        """Folder of all trained models."""
        return self.out / "models"

    def collect_settings(self) -> dict[str, Any]:
        """Return everything that the trained models depend on, except this machine's speed."""
        return {
            "params": self.params.get_fixed_settings(),
            "scenes": self.scenes.describe(),
            "budget": self.budget,
            "seeds": self.seeds,
            "version": __version__,
        }

    def to_training_request(self, model: Model, folder: Path) -> TrainingRequest:
        """Return the request to train one model in this folder."""
        split, val_split = self.scenes.write_splits(self.folder, model.label_share)
        return TrainingRequest(
            (self.scenes.data,),
            (),
            split,
            val_split,
            folder,
            True,
            None,
            self.device,
            self.jobs if self.jobs > 1 else 0,
        )


@dataclass(frozen=True)
class SharedPlan:
    """Training plan shared by all models.

    Attributes:
        values: Training parameters by dotted name.
        seeds: Number of seeds.
        durations: Expected training time of each model in seconds, by name. It does not contain
            models that are not trained.
        speeds: Measured speed of these models, by name.
    """

    values: dict[str, Any]
    seeds: int
    durations: dict[str, float]
    speeds: dict[str, Speed] = field(default_factory=dict)

    def apply(self, model: Model) -> Model:
        """Return the model with the numbers of the plan."""
        scans = self.values["data.scans"]  # number of simulated scans, 0 for none
        return replace(
            model,
            params=with_values(
                model.params, {**self.values, "data.scans": max(min(scans, 1), round(model.label_share * scans))}
            ),
        )


def plan_training(request: ModelRequest) -> SharedPlan:
    """Make the training plan of an experiment, or read it from a file if it was made before.

    Raises:
        InputError: The budget is too short, or no scene is usable.
    """
    file = request.folder / f"plan-{_hash(request.collect_settings())}.json"
    if file.exists():
        content = json.loads(read_text(file))
        speeds = {name: Speed(**speed) for name, speed in content.pop("speeds").items()}
        return SharedPlan(**content, speeds=speeds)
    plan = _make_plan(request)
    write_text(file, json.dumps(asdict(plan), indent=1))
    return plan


def _make_plan(request: ModelRequest) -> SharedPlan:
    import torch

    from lidar_perception.detectors.devices import find_device
    from lidar_perception.simulation.sensor import find_sensor
    from lidar_perception.training.planning import Planner
    from lidar_perception.training.trainers import make_trainer

    params: Any = request.params
    device = torch.device(find_device(request.device))
    errors.print("benchmarking this machine on a few scenes of each network ...")
    models = request.models(params, 0)
    speed_by_params: dict[Any, Speed] = {}
    reduced_range: dict[str, Any] = {}
    data = None
    for model in models:
        key = replace(model.params, seed=0)
        if key not in speed_by_params:
            trainer = make_trainer(model.params)
            planner = Planner(
                trainer,
                request.to_training_request(model, request.folder),
                model.params,
                find_sensor(model.params.sensor, model.params.mount_height),
                device,
            )
            sources = planner.open_few_scenes()
            speed_by_params[key] = planner.measure_speed(*sources)
            if model.label_share == 1.0 and data is None:
                data, reduced_range = planner.count_scenes(*sources), trainer.find_reduced_range(params)
    assert data is not None, "an experiment requires a model that is trained with all labels"
    speeds = {model.name: speed_by_params[replace(model.params, seed=0)] for model in models}
    user_plan = Plan(
        params.data.scans, params.data.val_scans, 0, params.steps, params.validate_steps, bool(reduced_range)
    )

    def fit_seeds(seeds: int) -> Plan:
        hours = request.budget or DEFAULT_BUDGET_H
        measuring_s = request.test_frames * sum(s.frame for s in speeds.values()) / request.jobs
        return fit_plan(
            max(0.1 * hours, hours - seeds * measuring_s / 3600),
            request.jobs,
            _add_speeds(list(speeds.values()) * seeds),
            data,
            user_plan,
            params.epochs,
        )

    optional_models = [] if params.steps or params.epochs else [model for model in models if not model.required]
    while True:
        try:
            plan = fit_seeds(request.seeds or 1)
            if plan.steps >= MIN_MODEL_STEPS or not optional_models:
                break
        except InputError:
            if not optional_models:
                raise
        dropped_model = optional_models.pop()
        del speeds[dropped_model.name]
        # Models with the same fraction of the labels are compared with each other, so all of them are dropped.
        while optional_models and optional_models[-1].label_share == dropped_model.label_share < 1.0:
            del speeds[optional_models.pop().name]
    seeds = request.seeds or min(max(plan.steps // STEPS_PER_SEED, 1), MAX_SEEDS)
    if seeds > (request.seeds or 1):
        plan = fit_seeds(seeds)
    if params.validate_epochs and not params.validate_steps:
        epoch = max(1, round((plan.scans + data.recorded) / data.batch))
        plan = replace(plan, validate_steps=params.compute_validation_steps(epoch))
    values = {
        "steps": plan.steps,
        "validate_steps": plan.validate_steps,
        "data.scans": plan.scans,
        "data.val_scans": plan.val_scans,
        **(reduced_range if plan.part else {}),
    }
    durations = {name: sum(estimate_training_durations(plan, speed, data)) for name, speed in speeds.items()}
    errors.print(
        f"training {seeds} x {len(speeds)} networks for {plan.steps} steps each: about "
        + format_duration(seeds * sum(durations.values()))
    )
    return SharedPlan(values, seeds, durations, speeds)


def _add_speeds(speeds: Sequence[Speed]) -> Speed:
    """Return the combined speed of training several networks on the same scans."""
    return Speed(
        max(s.cut for s in speeds),
        sum(s.step for s in speeds),
        sum(s.whole for s in speeds),
        sum(s.frame for s in speeds),
        speeds[0].scan,
        speeds[0].scan_mb,
    )


def train_models(request: ModelRequest, plan: SharedPlan) -> dict[str, TrainedModel]:
    """Train all models, or as many as fit into the budget, and return them by name.

    Raises:
        KeyboardInterrupt: The run was stopped. The same request resumes it.
        InputError: A network cannot be trained.
    """
    limit_s = math.inf if request.budget is None else 3600 * request.budget
    trained_models: dict[str, TrainedModel] = {}
    for seed in range(plan.seeds):
        for first_model, model in zip(request.models(request.params, 0), request.models(request.params, seed)):
            if first_model.name not in plan.durations:
                errors.print(f"{model.name} is left out because the budget is too short for it")
                continue
            planned_model = plan.apply(model)
            folder = request.folder / _name_folder(planned_model, request.scenes)
            if not (folder / "last.safetensors").exists():
                spent_s = sum(trained_model.seconds for trained_model in trained_models.values())
                is_optional = seed > 0 or not model.required
                if is_optional and spent_s + plan.durations[first_model.name] > limit_s:
                    errors.print(f"{model.name} is skipped because the budget is used up")
                    continue
                errors.print(f"training {model.name}", style="bold")
                _train(planned_model, request, folder, plan.speeds[first_model.name])
            trained_models[model.name] = read_trained_model(planned_model, folder)
    return trained_models


def _train(model: Model, request: ModelRequest, folder: Path, speed: Speed) -> None:
    from lidar_perception.cli.train import find_commit
    from lidar_perception.training.start import start_training
    from lidar_perception.training.trainers import make_trainer

    params = with_values(model.params, {"data.cache": str(request.out / "scans")})
    training_request = request.to_training_request(model, folder)
    result = start_training(make_trainer(params), training_request, params, find_commit(), speed)
    if result is not None and result.progress.stopped:
        errors.print("stopped; run the same command again to resume")
        raise KeyboardInterrupt


def read_trained_model(model: Model, folder: Path) -> TrainedModel:
    """Read the result of a finished training."""
    from lidar_perception.detectors.checkpoint import read_header

    best, last = folder / "best.safetensors", folder / "last.safetensors"
    record = read_header(last).training
    return TrainedModel(
        model,
        best,
        record["steps"],
        record["seconds"],
        read_header(best).training["steps"],
        record["scenes"],
        count_parameters(best),
    )


def count_parameters(weights: Path) -> int:
    """Count the learned parameters in a checkpoint."""
    from safetensors import safe_open

    with safe_open(weights, "np") as tensors:
        return sum(
            math.prod(tensors.get_slice(name).get_shape())
            for name in tensors.keys()
            if not name.endswith(NORM_STATISTICS)
        )


def _name_folder(model: Model, scenes: ExperimentScenes) -> str:
    """Return the name of a model's folder, which depends on its entire training configuration."""
    settings = {
        "params": model.params.get_fixed_settings(),
        "scenes": scenes.describe(),
        "labelled": model.label_share,
        "version": __version__,
    }
    return f"{re.sub(r'[^a-z0-9]+', '-', model.name.lower()).strip('-')}-{_hash(settings)}"


def _hash(settings: dict[str, Any]) -> str:
    return sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
