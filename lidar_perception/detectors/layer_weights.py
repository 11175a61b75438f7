"""Layer weights from the tensors of a checkpoint, with batch norms folded in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class WeightsMismatch(ValueError):
    """The tensors do not belong to the network. checkpoint.load_checkpoint(), which needs torch,
    names the first one that differs."""


class Weights(NamedTuple):
    """Weight (O, I, kh, kw) of a convolution or (O, I) of a linear layer, and bias (O,) or None,
    float32."""

    weight: np.ndarray
    bias: np.ndarray | None


class LayerWeights:
    """The layers of a network by name. Each layer can be taken once.

    Args:
        tensors: name -> array, the state_dict of a network in torch.
        eps: of the batch norms.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], eps: float):
        self.tensors, self.eps = dict(tensors), eps

    def take(self, name: str, shape: tuple[int, ...], norm: str | None = None) -> Weights:
        """Return a layer.

        Args:
            shape: of its weight.
            norm: name of the batch norm after a layer without bias. If the norm is already folded
                in, the layer has a bias and the norm does not exist.

        Raises:
            WeightsMismatch: the layer is missing or has another shape.
        """
        weight = self.array(f"{name}.weight", shape)
        if norm is None or f"{norm}.weight" not in self.tensors:
            return Weights(weight, self.array(f"{name}.bias", shape[:1]))
        scale, shift, mean, variance = (
            self.array(f"{norm}.{part}", shape[:1]) for part in ("weight", "bias", "running_mean", "running_var")
        )
        count = self.tensors.pop(f"{norm}.num_batches_tracked", None)
        if count is None or count.shape or count.dtype != np.int64:
            raise WeightsMismatch(f"{norm}.num_batches_tracked")
        scale = scale / np.sqrt(variance + np.float32(self.eps))
        return Weights(weight * scale.reshape(-1, *[1] * (len(shape) - 1)), shift - mean * scale)

    def array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Return a tensor of floats as float32, or raise WeightsMismatch."""
        found = self.tensors.pop(name, None)
        if found is None or found.shape != shape or not np.issubdtype(found.dtype, np.floating):
            raise WeightsMismatch(name)
        return found.astype(np.float32)

    def finish(self) -> None:
        """Raise WeightsMismatch if a tensor has not been taken."""
        for name in self.tensors:
            raise WeightsMismatch(name)


def to_arrays(network: Any) -> dict[str, np.ndarray]:
    """Return the state_dict of a torch network as arrays."""
    return {name: value.detach().cpu().numpy() for name, value in network.state_dict().items()}
