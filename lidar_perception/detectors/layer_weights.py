"""Layer weights from the tensors of a checkpoint, with batch norms folded in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np


class WeightsMismatch(ValueError):
    """The tensors do not fit the network; checkpoint.load_checkpoint() reports the first mismatch."""


class Weights(NamedTuple):
    """Weights of a layer, float32.

    Attributes:
        weight: (O, I, kh, kw) for a convolution, (O, I) for a linear layer.
        bias: (O,), or None.
    """

    weight: np.ndarray
    bias: np.ndarray | None


class LayerWeights:
    """Weights of the layers of a network; each layer can be taken once.

    Args:
        tensors: state_dict of the torch network as NumPy arrays.
        eps: epsilon of the batch norms.
    """

    def __init__(self, tensors: Mapping[str, np.ndarray], eps: float):
        self.tensors, self.eps = dict(tensors), eps

    def take(self, name: str, shape: tuple[int, ...], norm: str | None = None) -> Weights:
        """Remove a layer and return its weights.

        Args:
            shape: expected shape of the weight.
            norm: name of the batch norm that follows the layer. If the file has no such norm, it has
                already been folded into the layer, which then has a bias.

        Raises:
            WeightsMismatch: the layer is missing or has a different shape.
        """
        weight = self.take_array(f"{name}.weight", shape)
        if norm is None or f"{norm}.weight" not in self.tensors:
            return Weights(weight, self.take_array(f"{name}.bias", shape[:1]))
        scale, shift, mean, variance = (
            self.take_array(f"{norm}.{part}", shape[:1]) for part in ("weight", "bias", "running_mean", "running_var")
        )
        batch_count = self.tensors.pop(f"{norm}.num_batches_tracked", None)
        if batch_count is None or batch_count.shape or batch_count.dtype != np.int64:
            raise WeightsMismatch(f"{norm}.num_batches_tracked")
        scale = scale / np.sqrt(variance + np.float32(self.eps))
        return Weights(weight * scale.reshape(-1, *[1] * (len(shape) - 1)), shift - mean * scale)

    def take_array(self, name: str, shape: tuple[int, ...]) -> np.ndarray:
        """Remove a floating point tensor and return it as float32.

        Raises:
            WeightsMismatch: the tensor is missing, or its shape or type differs.
        """
        tensor = self.tensors.pop(name, None)
        if tensor is None or tensor.shape != shape or not np.issubdtype(tensor.dtype, np.floating):
            raise WeightsMismatch(name)
        return tensor.astype(np.float32)

    def require_all_taken(self) -> None:
        """Raise WeightsMismatch if a tensor has not been taken."""
        for name in self.tensors:
            raise WeightsMismatch(name)


def to_arrays(network: Any) -> dict[str, np.ndarray]:
    """Return the state_dict of a torch network as arrays."""
    return {name: value.detach().cpu().numpy() for name, value in network.state_dict().items()}
