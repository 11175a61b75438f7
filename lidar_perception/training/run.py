"""One training run: the network, its optimizer and its average, and a step of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field
from typing import Any, Generic

import torch
from torch import Tensor, nn

from lidar_perception.detectors.checkpoint import Net
from lidar_perception.detectors.devices import number_format
from lidar_perception.training.params import LoopParams
from lidar_perception.training.ranks import any_of, world
from lidar_perception.training.schedule import Average, one_cycle
from lidar_perception.types import InputError

Judged = tuple[dict[str, float], dict[str, tuple[float, float]]]  # see Task.validate


@dataclass(frozen=True)
class Task(Generic[Net]):
    """What is trained.

    module: on its device. loss(module, batch): the scalar to lower, and the parts to log; module is
    called as a function, as it may be wrapped for several processes. batches(step): the batches of
    that step, from 0, and all later ones, the same ones whenever it is asked. validate(module):
    metrics, of which 'score' counts, and what makes its scores probabilities
    (detectors/calibration.py). keep(name, module, record): write the weights under a name, 'best'
    or 'last'; record can be JSON. epoch: steps of one pass over the data. about: what else a
    resumed run must have in common with what was begun.
    """

    module: Net
    loss: Callable[[nn.Module, Any], tuple[Tensor, dict[str, Tensor]]]
    batches: Callable[[int], Iterable[Any]]
    validate: Callable[[Net], Judged]
    keep: Callable[[str, nn.Module, dict[str, Any]], None]
    epoch: int
    about: dict[str, Any] = field(default_factory=dict)


@dataclass
class Progress:
    """How far a run is: steps done, steps skipped (of them the last ones in a row), the best score
    and its step, the step of the last validation, seconds spent; left_out: planned steps that were
    left out of the schedule as there was no time for them; stopped: by a signal; late: the time was
    over."""

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
        self.every = params.validation_steps(task.epoch)
        self.module = task.module
        self.average = Average(self.module, params.ema)
        # Their statistics begin with means over all steps, so that the first values do not count.
        self.norms = [(m, m.momentum) for m in self.module.modules()
                      if isinstance(m, nn.modules.batchnorm._BatchNorm) and m.momentum is not None]
        self.called: nn.Module = self.module
        if world() > 1:
            self.called = nn.parallel.DistributedDataParallel(
                self.module, device_ids=[device] if device.type == "cuda" else None)
        self.optimizer = torch.optim.AdamW(self.module.parameters(), lr=params.lr,
                                           weight_decay=params.weight_decay)
        self.format = number_format(params.amp, device)
        self.scaler = torch.amp.GradScaler(device.type, enabled=self.format is torch.float16)
        self.progress = Progress()

    @property
    def place(self) -> float:
        """In the schedule, from 0 to steps: the steps done and left out."""
        return self.progress.step + self.progress.left_out

    @property
    def done(self) -> bool:
        """Whether the schedule is at its end."""
        return self.place >= self.steps

    def hurry(self, fit: float) -> None:
        """Leave out as much before the next step as before each later one, if so many are to bring
        the schedule to its end."""
        left, fit = self.steps - self.place, max(fit, 1.0)
        if left > fit:  # once fit is 1, one step is left, without an error of rounding
            self.progress.left_out = self.steps - self.progress.step - (left - left / fit + 1)

    def due(self) -> bool:
        """Whether the weights are to be validated now."""
        step = self.progress.step
        return step > self.progress.validated and (step % self.every == 0 or self.done)

    def asked(self) -> dict[str, Any]:
        """What a resumed run must have in common."""
        return {**self.params.decisive(), **self.task.about, "steps": self.steps,
                "processes": world()}

    def state(self) -> dict[str, Any]:
        cuda = torch.cuda.get_rng_state(self.device) if self.device.type == "cuda" else None
        return {"module": self.module.state_dict(), "average": self.average.module.state_dict(),
                "updates": self.average.updates, "optimizer": self.optimizer.state_dict(),
                "scaler": self.scaler.state_dict(), "progress": vars(self.progress).copy(),
                "random": torch.get_rng_state(), "cuda": cuda, "asked": self.asked()}

    def load(self, state: dict[str, Any]) -> None:
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
        """One step; what is to be logged, or None if it was skipped: then nothing has changed but
        the count."""
        rate, beta = one_cycle(self.place, self.steps, self.params.lr, self.params.warm_share)
        for group in self.optimizer.param_groups:
            group["lr"], group["betas"] = rate, (beta, group["betas"][1])
        for norm, momentum in self.norms:
            norm.momentum = max(momentum, 1 / (self.progress.step + 1))
        # A batch that is not finite leaves its mark on norms even if it is not learned from.
        buffers = [(buffer, buffer.clone()) for buffer in self.module.buffers()]
        self.called.train()
        with (torch.autocast(self.device.type, self.format) if self.format else nullcontext()):
            total, parts = self.task.loss(self.called, batch)
        length = self._learn(total)
        self.progress.step += 1
        if not math.isfinite(length):
            for buffer, before in buffers:
                buffer.copy_(before)
            self.progress.skipped += 1
            self.progress.in_a_row += 1
            if self.progress.in_a_row >= self.params.max_skipped:
                raise InputError(f"the loss or its gradient was not finite in "
                                 f"{self.progress.in_a_row} steps in a row, up to step "
                                 f"{self.progress.step}; lower --lr or look at the data")
            return None
        self.progress.in_a_row = 0
        self.average.update(self.module)
        return {"loss": total.item(), **{name: float(part) for name, part in parts.items()},
                "gradient": length, "lr": rate}

    def _learn(self, total: Tensor) -> float:
        """Step down the gradient; its length, which is not finite where nothing was done."""
        if any_of(not torch.isfinite(total).item(), self.device):
            return math.nan
        self.optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(total).backward()
        self.scaler.unscale_(self.optimizer)
        length = nn.utils.clip_grad_norm_(self.module.parameters(),
                                          self.params.clip or math.inf).item()
        if math.isfinite(length):
            self.scaler.step(self.optimizer)
        self.scaler.update()
        return length
