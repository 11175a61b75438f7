"""Learning rate schedule, and moving average of the weights."""

from __future__ import annotations

import copy
import math

import torch
from torch import nn

START_DIVISOR, END_DIVISOR = 10.0, 1e4  # initial rate: lr / 10; final rate: lr / 10 / 1e4
SLOW_MOMENTUM, FAST_MOMENTUM = 0.95, 0.85  # momentum at the lowest and the highest rate


def compute_one_cycle(step: float, steps: int, lr: float, warm_share: float) -> tuple[float, float]:
    """Return learning rate and momentum of a step in 0 .. steps - 1 (one-cycle, Smith 2018).

    The rate rises to lr during the share warm_share of the steps, then falls, both along cosines.
    """
    first, last = lr / START_DIVISOR, lr / START_DIVISOR / END_DIVISOR
    top = warm_share * steps - 1
    if step <= top:
        share = _cosine_ramp(step / top) if top > 0 else 1.0  # a single rising step is the top
        return (first + (lr - first) * share, SLOW_MOMENTUM + (FAST_MOMENTUM - SLOW_MOMENTUM) * share)
    share = _cosine_ramp((step - top) / (steps - 1 - top)) if steps - 1 > top else 1.0
    return lr + (last - lr) * share, FAST_MOMENTUM + (SLOW_MOMENTUM - FAST_MOMENTUM) * share


def _cosine_ramp(x: float) -> float:
    return (1 - math.cos(math.pi * min(max(x, 0.0), 1.0))) / 2


class WeightAverage:
    """Exponential moving average of a module's weights and norm statistics, as a module.

    Update t (from 1) keeps min(decay, t / (t + 9)) of the average, so that the random initial
    weights are soon forgotten.
    """

    def __init__(self, module: nn.Module, decay: float):
        self.module = copy.deepcopy(module).requires_grad_(False).eval()
        self.decay, self.updates = decay, 0

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Add the module's current weights. Integer buffers are copied."""
        self.updates += 1
        decay = min(self.decay, self.updates / (self.updates + 9))
        for mean, value in zip(self.module.state_dict().values(), module.state_dict().values()):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)
