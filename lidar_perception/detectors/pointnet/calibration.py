"""Temperature scaling, after which a score of 0.8 is correct in 80 % of cases (Guo et al., ICML 2017)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from lidar_perception.detectors.pointnet.network import PointNet

MAX_ITERATIONS = 60  # maximum iterations of the optimizer


def calibrate(network: PointNet, logits: Tensor, labels: Tensor) -> None:
    """Fit the network's temperature and offsets to labels, in place.

    The offsets compensate for classes that are rarer on real roads than in training.

    Args:
        logits: (B, K + 1).
        labels: (B,) int64; negative labels are ignored. If all are negative, nothing changes.
    """
    is_labelled = labels >= 0
    if not is_labelled.any():
        return
    logits, labels = logits[is_labelled].detach().double().cpu(), labels[is_labelled].cpu()
    log_temperature = torch.zeros(1, dtype=torch.double, requires_grad=True)
    offsets = torch.zeros(logits.shape[1], dtype=torch.double, requires_grad=True)
    optimizer = torch.optim.LBFGS([log_temperature, offsets], max_iter=MAX_ITERATIONS, line_search_fn="strong_wolfe")

    def compute_loss() -> Tensor:
        optimizer.zero_grad()
        calibrated_logits = logits / log_temperature.clamp(-3, 3).exp() + offsets
        # Without regularization, the offset of a class without examples would go to minus infinity.
        loss = functional.cross_entropy(calibrated_logits, labels) + 1e-3 * offsets.square().sum()
        loss.backward()
        return loss

    optimizer.step(compute_loss)
    network.temperature.copy_(log_temperature.detach().clamp(-3, 3).exp())
    network.offsets.copy_(offsets.detach())


def compute_calibration_error(probabilities: np.ndarray, labels: np.ndarray, bins: int = 10) -> float:
    """Compute the expected calibration error in bins of equal width.

    This is the mean difference between the highest probability and the accuracy; 0 without examples.

    Args:
        probabilities: (B, K).
        labels: (B,).
    """
    confidence = probabilities.max(axis=1)
    is_correct = probabilities.argmax(axis=1) == labels
    bin_index = np.minimum((confidence * bins).astype(int), bins - 1)
    gap = sum(abs(confidence[bin_index == i].sum() - is_correct[bin_index == i].sum()) for i in range(bins))
    return float(gap / max(len(labels), 1))
