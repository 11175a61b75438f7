"""The learning rate of each step, and the average of the weights over the steps."""

from __future__ import annotations

import copy
import math

import torch
from torch import nn

START, END = 10.0, 1e4          # the first rate is lr / START, the last that / END
SLOW, FAST = 0.95, 0.85         # momentum while the rate is least and greatest


def one_cycle(step: float, steps: int, lr: float, warm_share: float) -> tuple[float, float]:
    """Learning rate and momentum of step 0 .. steps - 1: up to lr and down again along cosines
    (Smith, 2018)."""
    first, last = lr / START, lr / START / END
    top = warm_share * steps - 1
    if step <= top:
        share = _ramp(step / top) if top > 0 else 1.0  # of one step up: it is the highest
        return first + (lr - first) * share, SLOW + (FAST - SLOW) * share
    share = _ramp((step - top) / (steps - 1 - top)) if steps - 1 > top else 1.0
    return lr + (last - lr) * share, FAST + (SLOW - FAST) * share


def _ramp(x: float) -> float:
    return (1 - math.cos(math.pi * min(max(x, 0.0), 1.0))) / 2


class Average:
    """The exponential moving average of a module's weights and norms, as a module.

    The t-th update (from 1) keeps min(decay, t / (t + 9)) of the average, so that the random
    weights of the beginning are soon forgotten.
    """

    def __init__(self, module: nn.Module, decay: float):
        self.module = copy.deepcopy(module).requires_grad_(False).eval()
        self.decay, self.updates = decay, 0

    @torch.no_grad()
    def update(self, module: nn.Module) -> None:
        """Take in the module's present weights; numbers that are not float are copied."""
        self.updates += 1
        decay = min(self.decay, self.updates / (self.updates + 9))
        for mean, value in zip(self.module.state_dict().values(), module.state_dict().values()):
            if mean.is_floating_point():
                mean.lerp_(value, 1 - decay)
            else:
                mean.copy_(value)
