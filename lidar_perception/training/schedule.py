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
    first, last = lr / START_DIVISOR, lr / START_DIVISOR / END_DIVISOR
    top = warm_share * steps - 1
    if step <= top:
        share = _cosine_ramp(step / top) if top > 0 else 1.0
        return (first + (lr - first) * share, MAX_MOMENTUM + (MIN_MOMENTUM - MAX_MOMENTUM) * share)
    share = _cosine_ramp((step - top) / (steps - 1 - top)) if steps - 1 > top else 1.0
    return lr + (last - lr) * share, MIN_MOMENTUM + (MAX_MOMENTUM - MIN_MOMENTUM) * share


def _cosine_ramp(x: float) -> float:
    return (1 - math.cos(math.pi * min(max(x, 0.0), 1.0))) / 2


class WeightAverage:
    """Exponential moving average of a module's weights and norm statistics, as a module.

    The decay of update t (from 1) is min(decay, t / (t + 9)), so that the initial weights are soon
    forgotten.
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
