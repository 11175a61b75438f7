"""Learning rate schedule, and moving average of the weights."""

from __future__ import annotations

import copy
import math

import torch
from torch import nn

START_DIVISOR, END_DIVISOR = 10.0, 1e4  # the first rate is lr / 10, the last lr / 10 / 1e4
MAX_MOMENTUM, MIN_MOMENTUM = 0.95, 0.85  # momentum at the lowest and the highest rate


def compute_one_cycle(step: float, steps: int, lr: float, warm_share: float) -> tuple[float, float]:
    """Compute learning rate and momentum of a step in 0 .. steps - 1 (one-cycle policy, Smith 2018).

    The rate rises to lr in the first warm_share of the steps and then falls, both along cosines.
    """
    first_rate, last_rate = lr / START_DIVISOR, lr / START_DIVISOR / END_DIVISOR
    peak_step = warm_share * steps - 1
    if step <= peak_step:
        ramp = _cosine_ramp(step / peak_step) if peak_step > 0 else 1.0
        return (first_rate + (lr - first_rate) * ramp, MAX_MOMENTUM + (MIN_MOMENTUM - MAX_MOMENTUM) * ramp)
    ramp = _cosine_ramp((step - peak_step) / (steps - 1 - peak_step)) if steps - 1 > peak_step else 1.0
    return lr + (last_rate - lr) * ramp, MIN_MOMENTUM + (MAX_MOMENTUM - MIN_MOMENTUM) * ramp


def _cosine_ramp(x: float) -> float:
    return (1 - math.cos(math.pi * min(max(x, 0.0), 1.0))) / 2


class WeightAverage:
    """Exponential moving average of a module's weights and norm statistics, as a module.

    The decay of update t (from 1) is min(decay, t / (t + 9)), so that the initial weights soon have
    no effect.
    """

    def __init__(self, module: nn.Module, decay: float):
        self.module = copy.deepcopy(module).requires_grad_(False).eval()
        self.decay, self.updates = decay, 0

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Update the average with the current weights of the module. Integer buffers are copied."""
        self.updates += 1
        decay = min(self.decay, self.updates / (self.updates + 9))
        for mean, value in zip(self.module.state_dict().values(), module.state_dict().values()):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)
