"""State of a training run: network, optimizer and weight average; and one training step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, Generic

import torch
from torch import Tensor, nn

from lidar_perception.detectors.checkpoint import Net
from lidar_perception.detectors.devices import choose_dtype
from lidar_perception.training.distributed import get_world_size, is_true_anywhere
from lidar_perception.training.params import LoopParams
from lidar_perception.training.schedule import WeightAverage, compute_one_cycle
from lidar_perception.types import InputError

Validation = tuple[dict[str, float], dict[str, tuple[float, float]]]  # see Task.validate


@dataclass(frozen=True)
class Task(Generic[Net]):
    """A network with its loss, data, validation and checkpoints.

    Attributes:
        module: The network, on its device.
        loss: loss(module, batch) -> (scalar to minimise, parts to log). It must call module as a
            function, since module may be wrapped for several processes.
        batches: batches(step) -> iterator over the batches of this step (from 0) and all later ones.
            Repeated calls give the same batches.
        validate: validate(module) -> (metrics, calibration). The metric "score" selects the best
            weights; the calibration converts scores to probabilities, see
            detectors/calibration.py.
        save: save(name, module, record) writes the weights "best" or "last"; the record is JSON data.
        steps_per_epoch: Number of steps per epoch.
        data_info: Description of the data, which must not change when the run is resumed.
    """

    module: Net
    loss: Callable[[nn.Module, Any], tuple[Tensor, dict[str, Tensor]]]
    batches: Callable[[int], Iterable[Any]]
    validate: Callable[[Net], Validation]
    save: Callable[[str, nn.Module, dict[str, Any]], None]
    steps_per_epoch: int
    data_info: dict[str, Any] = field(default_factory=dict)


@dataclass
class Progress:
    """Progress of a run. The names of the attributes are part of the format of the state.

    Attributes:
        step: Number of finished steps.
        skipped: Number of steps skipped because the loss or gradient was not finite.
        in_a_row: Number of consecutive skipped steps.
        best, best_step: Best score so far and its step.
        validated: Step of the last validation.
        seconds: Duration of the run.
        left_out: Number of planned steps removed from the schedule for lack of time.
        stopped: True if a signal stopped the run.
        late: True if the time budget is spent.
    """

    step: int = 0
    skipped: int = 0
    in_a_row: int = 0
    best: float | None = None
    best_step: int = 0
    validated: int = 0
    seconds: float = 0.0
    left_out: float = 0.0
    stopped: bool = False
    late: bool = False


class Run:
    """State of a training run: network, optimizer, weight average and progress."""

    def __init__(self, task: Task, params: LoopParams, device: torch.device):
        self.task, self.params, self.device = task, params, device
        self.steps = params.compute_total_steps(task.steps_per_epoch)
        self.validate_steps = params.compute_validation_steps(task.steps_per_epoch)
        self.module = task.module
        self.average = WeightAverage(self.module, params.ema)
        # In the first steps, norm statistics are means over all steps so far: their initial values are arbitrary.
        self.norms = [
            (m, m.momentum)
            for m in self.module.modules()
            if isinstance(m, nn.modules.batchnorm._BatchNorm) and m.momentum is not None
        ]
        self.parallel_module: nn.Module = self.module
        if get_world_size() > 1:
            self.parallel_module = nn.parallel.DistributedDataParallel(
                self.module, device_ids=[device] if device.type == "cuda" else None
            )
        self.optimizer = torch.optim.AdamW(self.module.parameters(), lr=params.lr, weight_decay=params.weight_decay)
        self.dtype = choose_dtype(params.amp, device)
        self.scaler = torch.amp.GradScaler(device.type, enabled=self.dtype is torch.float16)
        self.progress = Progress()

    @property
    def position(self) -> float:
        """Position in the schedule, 0 .. steps: finished steps plus removed ones."""
        return self.progress.step + self.progress.left_out

    @property
    def is_done(self) -> bool:
        """True at the end of the schedule."""
        return self.position >= self.steps

    def shorten_schedule(self, remaining_steps: float) -> None:
        """Remove steps evenly, so that the schedule ends after `remaining_steps` more steps, at least one."""
        planned_steps, remaining_steps = self.steps - self.position, max(remaining_steps, 1.0)
        if planned_steps > remaining_steps:  # the next step then advances the schedule by their ratio
            self.progress.left_out = (
                self.steps - self.progress.step - (planned_steps - planned_steps / remaining_steps + 1)
            )

    def is_validation_due(self) -> bool:
        """Return True if the current weights must be validated."""
        step = self.progress.step
        return step > self.progress.validated and (step % self.validate_steps == 0 or self.is_done)

    def collect_settings(self) -> dict[str, Any]:
        """Return the settings that must not change when the run is resumed."""
        return {
            **self.params.get_fixed_settings(),
            **self.task.data_info,
            "steps": self.steps,
            "processes": get_world_size(),
        }

    def make_state(self) -> dict[str, Any]:
        """Return the state from which the run can be resumed, for torch.save."""
        cuda = torch.cuda.get_rng_state(self.device) if self.device.type == "cuda" else None
        return {
            "module": self.module.state_dict(),
            "average": self.average.module.state_dict(),
            "updates": self.average.updates,
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.scaler.state_dict(),
            "progress": vars(self.progress).copy(),
            "random": torch.get_rng_state(),
            "cuda": cuda,
            "asked": self.collect_settings(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restore a state returned by make_state."""
        self.module.load_state_dict(state["module"])
        self.average.module.load_state_dict(state["average"])
        self.average.updates = state["updates"]
        self.optimizer.load_state_dict(state["optimizer"])
        self.scaler.load_state_dict(state["scaler"])
        self.progress = Progress(**{**state["progress"], "stopped": False, "late": False})
        torch.set_rng_state(state["random"])
        if state["cuda"] is not None and self.device.type == "cuda":
            torch.cuda.set_rng_state(state["cuda"], self.device)

    def step(self, batch: Any) -> dict[str, float] | None:
        """Train on one batch.

        Returns:
            Values to log, or None if the step was skipped, which changes only the counters.

        Raises:
            InputError: Loss or gradient was not finite in too many consecutive steps.
        """
        learning_rate, beta = compute_one_cycle(self.position, self.steps, self.params.lr, self.params.warm_share)
        for group in self.optimizer.param_groups:
            group["lr"], group["betas"] = learning_rate, (beta, group["betas"][1])
        for norm, momentum in self.norms:
            norm.momentum = max(momentum, 1 / (self.progress.step + 1))
        # A skipped step must not change the norm statistics, so their old values are saved.
        saved_buffers = [(buffer, buffer.clone()) for buffer in self.module.buffers()]
        self.parallel_module.train()
        with torch.autocast(self.device.type, self.dtype) if self.dtype else nullcontext():
            total, parts = self.task.loss(self.parallel_module, batch)
        gradient_norm = self._descend(total)
        self.progress.step += 1
        if not math.isfinite(gradient_norm):
            for buffer, old_value in saved_buffers:
                buffer.copy_(old_value)
            self.progress.skipped += 1
            self.progress.in_a_row += 1
            if self.progress.in_a_row >= self.params.max_skipped:
                raise InputError(
                    f"the loss or its gradient was not finite in {self.progress.in_a_row} consecutive steps, up to "
                    f"step {self.progress.step}; lower --lr or check the data"
                )
            return None
        self.progress.in_a_row = 0
        self.average.update(self.module)
        return {
            "loss": total.item(),
            **{name: float(part) for name, part in parts.items()},
            "gradient": gradient_norm,
            "lr": learning_rate,
        }

    def _descend(self, total: Tensor) -> float:
        """Make an optimizer step. Return the norm of the gradient, which is not finite if the step was skipped."""
        if is_true_anywhere(not torch.isfinite(total).item(), self.device):
            return math.nan
        self.optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(total).backward()
        self.scaler.unscale_(self.optimizer)
        norm = nn.utils.clip_grad_norm_(self.module.parameters(), self.params.clip or math.inf).item()
        if math.isfinite(norm):
            self.scaler.step(self.optimizer)
        self.scaler.update()
        return norm
