"""State of a training run: the network, its optimizer and weight average, and a step of them."""

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
    """A network to train, and how.

    Attributes:
        module: The network, on its device.
        loss: loss(module, batch) -> (scalar to minimise, parts to log). Calls module as a
            function, since it may be wrapped for several processes.
        batches: batches(step) -> batches from that step (counted from 0) on, always the same.
        validate: validate(module) -> (metrics, calibration). The metric "score" selects the best
            weights; the calibration turns scores into probabilities, see
            detectors/calibration.py.
        save: save(name, module, record) writes weights named "best" or "last"; the record fits
            into JSON.
        epoch: Steps of one pass over the data.
        about: Further settings that a resumed run must have in common.
    """

    module: Net
    loss: Callable[[nn.Module, Any], tuple[Tensor, dict[str, Tensor]]]
    batches: Callable[[int], Iterable[Any]]
    validate: Callable[[Net], Validation]
    save: Callable[[str, nn.Module, dict[str, Any]], None]
    epoch: int
    about: dict[str, Any] = field(default_factory=dict)


@dataclass
class Progress:
    """Progress of a run, as it is stored.

    Attributes:
        step: Steps done.
        skipped: Steps skipped because of a loss or gradient that was not finite.
        in_a_row: Skipped steps since the last good one.
        best, best_step: Best score so far and its step.
        validated: Step of the last validation.
        seconds: Time spent.
        left_out: Planned steps removed from the schedule for lack of time.
        stopped: A signal stopped the run.
        late: The time budget is spent.
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
    """Everything that changes from step to step."""

    def __init__(self, task: Task, params: LoopParams, device: torch.device):
        self.task, self.params, self.device = task, params, device
        self.steps = params.total_steps(task.epoch)
        self.validate_steps = params.validation_steps(task.epoch)
        self.module = task.module
        self.average = WeightAverage(self.module, params.ema)
        # Norm statistics start as means over all steps, so that the initial values have no effect.
        self.norms = [
            (m, m.momentum)
            for m in self.module.modules()
            if isinstance(m, nn.modules.batchnorm._BatchNorm) and m.momentum is not None
        ]
        self.wrapped: nn.Module = self.module
        if get_world_size() > 1:
            self.wrapped = nn.parallel.DistributedDataParallel(
                self.module, device_ids=[device] if device.type == "cuda" else None
            )
        self.optimizer = torch.optim.AdamW(self.module.parameters(), lr=params.lr, weight_decay=params.weight_decay)
        self.format = choose_dtype(params.amp, device)
        self.scaler = torch.amp.GradScaler(device.type, enabled=self.format is torch.float16)
        self.progress = Progress()

    @property
    def position(self) -> float:
        """Position in the schedule, 0 .. steps: the steps done and left out."""
        return self.progress.step + self.progress.left_out

    @property
    def done(self) -> bool:
        """True at the end of the schedule."""
        return self.position >= self.steps

    def shorten_schedule(self, fit: float) -> None:
        """Leave out steps evenly so that `fit` more steps reach the end of the schedule."""
        left, fit = self.steps - self.position, max(fit, 1.0)
        if left > fit:  # once fit is 1, exactly one step is left, without rounding errors
            self.progress.left_out = self.steps - self.progress.step - (left - left / fit + 1)

    def is_validation_due(self) -> bool:
        """Return True if the weights are to be validated after the last step."""
        step = self.progress.step
        return step > self.progress.validated and (step % self.validate_steps == 0 or self.done)

    def settings(self) -> dict[str, Any]:
        """Return everything that a resumed run must have in common."""
        return {**self.params.fixed_settings(), **self.task.about, "steps": self.steps, "processes": get_world_size()}

    def state(self) -> dict[str, Any]:
        """Return everything needed to resume, for torch.save."""
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
            "asked": self.settings(),
        }

    def load(self, state: dict[str, Any]) -> None:
        """Restore what state() returned."""
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
            Values to log, or None if the step was skipped: then only the counters have changed.

        Raises:
            InputError: Too many steps in a row were not finite.
        """
        rate, beta = compute_one_cycle(self.position, self.steps, self.params.lr, self.params.warm_share)
        for group in self.optimizer.param_groups:
            group["lr"], group["betas"] = rate, (beta, group["betas"][1])
        for norm, momentum in self.norms:
            norm.momentum = max(momentum, 1 / (self.progress.step + 1))
        # A batch that is not finite changes the norm statistics even if its step is skipped.
        buffers = [(buffer, buffer.clone()) for buffer in self.module.buffers()]
        self.wrapped.train()
        with torch.autocast(self.device.type, self.format) if self.format else nullcontext():
            total, parts = self.task.loss(self.wrapped, batch)
        gradient_norm = self._descend(total)
        self.progress.step += 1
        if not math.isfinite(gradient_norm):
            for buffer, before in buffers:
                buffer.copy_(before)
            self.progress.skipped += 1
            self.progress.in_a_row += 1
            if self.progress.in_a_row >= self.params.max_skipped:
                raise InputError(
                    f"the loss or its gradient was not finite in "
                    f"{self.progress.in_a_row} steps in a row, up to step "
                    f"{self.progress.step}; lower --lr or check the data"
                )
            return None
        self.progress.in_a_row = 0
        self.average.update(self.module)
        return {
            "loss": total.item(),
            **{name: float(part) for name, part in parts.items()},
            "gradient": gradient_norm,
            "lr": rate,
        }

    def _descend(self, total: Tensor) -> float:
        """Step along the gradient. Returns its norm, not finite if the step was skipped."""
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
