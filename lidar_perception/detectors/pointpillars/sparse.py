"""Sparse CPU inference for networks that do not read the ground.

Without the ground, about 2 % of the pillars contain points. Where the receptive field of a layer
contains neither points nor cells of the cluster map, the output is the same as for an empty cloud:
one feature vector, and a few others near the border of the grid. These are computed once. For each
cloud, the layers compute only the remaining cells, and only those that the head needs. The head is
evaluated up to REACH cells from a point, because nothing is detected farther away. The result
equals that of torch up to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from lidar_perception.detectors.layer_weights import LayerWeights, Weights
from lidar_perception.detectors.matrix_kernel import BLOCK, LANES, pack_weights, pad_bias, pad_channels
from lidar_perception.detectors.parallel import run_in_parts
from lidar_perception.detectors.pointpillars import sparse_kernels as kernels
from lidar_perception.detectors.pointpillars.config import BINS, CODE, NORM_EPS, NetworkConfig
from lidar_perception.detectors.pointpillars.pillars import Pillars
from lidar_perception.detectors.pointpillars.prediction import Prediction
from lidar_perception.detectors.pointpillars.sparse_layers import Grid, Layer, dilate, make_layers, shrink

REACH = 6  # distance from a point, in cells, up to which the head is evaluated
MIN_PER_PART = 1_000_000  # minimum number of multiplications per part of run_in_parts


class Map(NamedTuple):
    """Feature map of H x W cells; many cells can share a row of features.

    Attributes:
        row_index: (H + 2, W + 2) int32, the row of each cell. The border, the padding of convolutions,
            refers to row 0.
        rows: (R, C) float32; row 0 is zero.
    """

    row_index: np.ndarray
    rows: np.ndarray

    def get_features(self, cells: np.ndarray) -> np.ndarray:
        """Return the features (M, C) of the cells with flat indices (M,)."""
        width = self.row_index.shape[1] - 2
        return self.rows[self.row_index[1 + cells // width, 1 + cells % width]]


def find_unsupported_feature(config: NetworkConfig) -> str | None:
    """Return the reason why SparseNetwork cannot run a network on this machine; None if it can."""
    if not LANES:
        return "this processor has no AVX2"
    if not config.remove_ground:
        return f"{config.version} also reads the ground, which occupies most cells"
    if config.neck != "fpn" or config.fusion != "add":
        return "its neck is not an FPN that adds its maps"
    if config.zero_row:
        return "its pillars are padded with zeros (zero_row)"
    return None


class SparseNetwork:
    """PointPillars network with sparse inference on the CPU; it can be called from several threads.

    Args:
        config: config for which find_unsupported_feature returns None.
        tensors: state_dict of network.make_network(config), by name.

    Raises:
        WeightsMismatch: the tensors belong to a different network.
    """

    has_fixed_range = False

    def __init__(self, config: NetworkConfig, tensors: Mapping[str, np.ndarray]):
        self.config = config
        weights = LayerWeights(tensors, NORM_EPS)
        self.has_map = config.pseudo_map
        self.first_block = 2 + len(config.map_channels) if config.pseudo_map else 1
        point_columns, offset_columns = config.point_columns, config.offset_columns
        column_count = point_columns + offset_columns
        linear, bias = weights.take("pillar_net.linear", (config.pillar_channels, column_count), "pillar_net.norm")
        self.layers = make_layers(config, weights)
        per_cell = config.anchors_per_cell
        self.codes, self.directions = (
            weights.take(f"head.{name}", (per_cell * width, config.fpn_channels, 1, 1))
            for name, width in (("codes", CODE), ("directions", BINS))
        )
        weights.require_all_taken()
        scales = np.ones(column_count, np.float32)
        scales[:2], scales[4 + offset_columns :] = config.xy_scale, config.id_scale
        # In the checkpoint the cluster id comes after the offsets; here all point columns come first.
        order = [*range(4), *range(4 + offset_columns, column_count), *range(4, 4 + offset_columns)]
        pillar_weights = (linear * scales)[:, order]
        self.pillar_weights = pack_weights(pillar_weights[:, :, None])
        self.pillar_bias = pad_bias(bias, len(self.pillar_weights) * BLOCK)
        self.pillar_columns = pad_channels(config.pillar_channels)
        self._empty_maps: dict[Grid, list[Map]] = {}

    def to(self, device: str) -> None:
        """Do nothing: the network stays on the CPU."""

    def __call__(self, pillars: Pillars[np.ndarray], maps: np.ndarray | None) -> Prediction:
        """Return the outputs for the anchors of all cells up to REACH from a point."""
        cells, features, logits = self.evaluate(pillars, maps, REACH)
        per_cell = self.config.anchors_per_cell
        anchors = (cells[:, None] * per_cell + np.arange(per_cell)).ravel()

        def compute_boxes(indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            rows = features.get_features(cells[indices // per_cell])[:, : self.config.fpn_channels]
            slots = indices % per_cell
            return (
                _evaluate_at(self.codes, per_cell, slots, rows),
                _evaluate_at(self.directions, per_cell, slots, rows),
            )

        return Prediction(logits.reshape(-1, len(self.config.classes)), compute_boxes, anchors)

    def evaluate(
        self, pillars: Pillars[np.ndarray], maps: np.ndarray | None, reach: int | None
    ) -> tuple[np.ndarray, Map, np.ndarray]:
        """Evaluate the network at the cells of the head that are near a point.

        Args:
            pillars: pillars of one cloud, which may be empty.
            maps: cluster map, see prediction.Network.
            reach: maximum distance from a point, in cells of the head; None: all cells.

        Returns:
            Flat indices (M,) int64 of the evaluated cells, the map that the head reads, and
            logits (M, anchors per cell * K) float32.
        """
        inputs = [self._make_pillar_map(pillars)]
        if self.has_map:
            assert maps is not None
            inputs.append(_make_cluster_map(maps[0]))
        empty_maps = self._make_empty_maps(pillars.grid)
        cell_masks = self._choose_cells([source.row_index[1:-1, 1:-1] > 0 for source in inputs], reach)
        *_, features, scores = self._run(inputs, cell_masks, empty_maps)
        logits = scores.rows[len(empty_maps[-1].rows) :, : self.config.anchors_per_cell * len(self.config.classes)]
        return np.flatnonzero(cell_masks[-1]), features, np.ascontiguousarray(logits)

    def _make_pillar_map(self, pillars: Pillars[np.ndarray]) -> Map:
        points, offsets, cells = pillars[:3]
        has_points = np.zeros(pillars.grid, bool)
        has_points.ravel()[cells] = True
        occupied_cells, index = kernels.number_cells(has_points, _make_blank_index(pillars.grid), 1)
        rows = np.zeros((1 + len(occupied_cells), self.pillar_columns), np.float32)
        kernels.write_pillar_maxima(points, offsets, cells, index, self.pillar_weights, self.pillar_bias, rows)
        return Map(index, rows)

    def _choose_cells(self, input_masks: list[np.ndarray], reach: int | None) -> list[np.ndarray]:
        """Return a mask (H, W) bool of the cells to compute for each layer.

        The input masks (H, W) bool are True for the occupied cells of the input maps.
        """
        masks = list(input_masks)
        for layer in self.layers:
            masks.append(layer.find_affected_cells(masks))
        if reach is None:
            masks[-1] = np.ones_like(masks[-1])
        else:
            scale = len(input_masks[0]) // len(masks[-1])
            masks[-1] = dilate(shrink(input_masks[0], scale), reach)
        # The layers before the blocks have so few cells that selecting some of them would take longer
        # than computing all.
        required_masks = [None if i < self.first_block else np.zeros_like(mask) for i, mask in enumerate(masks)]
        required_masks[-1] = masks[-1]
        for i, mask in reversed([*enumerate(required_masks)]):
            if mask is not None:
                self.layers[i - len(input_masks)].mark_required_cells(mask, required_masks)
                masks[i] &= mask
        return masks[len(input_masks) :]

    def _run(self, inputs: list[Map], cell_masks: Sequence[np.ndarray], empty_maps: Sequence[Map]) -> list[Map]:
        """Return the maps of all layers; cells outside the masks have the values of an empty cloud."""
        maps = list(inputs)
        for layer, mask, background in zip(self.layers, cell_masks, empty_maps):
            maps.append(_compute_map(layer, maps, mask, background))
        return maps[len(inputs) :]

    def _make_empty_maps(self, grid: Grid) -> list[Map]:
        """Return the maps of all layers for an empty cloud.

        Values depend only on the distance to the border, so the layers run on the smallest grid
        in which all relevant distances occur.
        """
        if grid not in self._empty_maps:
            input_count = 2 if self.has_map else 1
            margins, grids = [0] * input_count, [grid] * input_count
            for layer in self.layers:
                margins.append(layer.compute_margin(margins))
                grids.append(layer.compute_grid(grids))
            max_stride = grid[0] // min(height for height, _ in grids)
            size = max((2 * margin + 1) * (grid[0] // height) for margin, (height, _) in zip(margins, grids))
            size = -(-size // max_stride) * max_stride
            small_grid = min(size, grid[0]), min(size, grid[1])
            small_grids = [small_grid] * input_count
            for layer in self.layers:
                small_grids.append(layer.compute_grid(small_grids))
            inputs = [
                Map(_make_blank_index(small_grid), np.zeros((1, width), np.float32))
                for width in (self.pillar_columns, pad_channels(3))[:input_count]
            ]
            maps = self._run(
                inputs,
                [np.ones(g, bool) for g in small_grids[input_count:]],
                [
                    Map(_make_blank_index(g), np.zeros((1, len(layer.bias)), np.float32))
                    for g, layer in zip(small_grids[input_count:], self.layers)
                ],
            )
            self._empty_maps[grid] = [
                _enlarge_map(*arguments) for arguments in zip(maps, margins[input_count:], grids[input_count:])
            ]
        return self._empty_maps[grid]


def _evaluate_at(layer: Weights, per_cell: int, slots: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Evaluate a layer of the head at N anchors; return (N, C / per_cell).

    `slots` (N,) is the index of each anchor within its cell, `rows` (N, B) are the cells' features.
    """
    weight = layer.weight.reshape(per_cell, -1, rows.shape[1])[slots]
    assert layer.bias is not None
    return (weight @ rows[:, :, None])[:, :, 0] + layer.bias.reshape(per_cell, -1)[slots]


def _make_blank_index(grid: Grid) -> np.ndarray:
    """Return an index in which all cells refer to row 0."""
    return np.zeros((grid[0] + 2, grid[1] + 2), np.int32)


def _make_cluster_map(maps: np.ndarray) -> Map:
    """Convert cluster maps (3, H, W) uint8 to a Map."""
    is_occupied = (maps[0] | maps[1] | maps[2]) > 0
    cells, index = kernels.number_cells(is_occupied, _make_blank_index(is_occupied.shape), 1)
    rows = np.zeros((1 + len(cells), pad_channels(3)), np.float32)
    rows[1:, :3] = maps.reshape(3, -1)[:, cells].T
    return Map(index, rows)


def _compute_map(layer: Layer, maps: list[Map], mask: np.ndarray, background: Map) -> Map:
    """Return the map of a layer, computed in the cells of `mask` (H, W) bool."""
    background_count = len(background.rows)
    cells, index = kernels.number_cells(mask, background.row_index, background_count)
    rows = np.empty((background_count + len(cells), len(layer.bias)), np.float32)
    rows[:background_count] = background.rows
    sums, width = rows[background_count:], mask.shape[1]

    def compute(begin: int, end: int) -> None:
        bias = layer.bias
        if layer.coarse is not None:
            kernels.upsample(*maps[layer.coarse], cells, width, layer.scale, bias, sums, begin, end)
            bias = bias[:0]
        for i, (source, weights) in enumerate(zip(layer.sources, layer.weights), start=1):
            floor = layer.floor if i == len(layer.sources) else -np.inf
            kernels.convolve(
                *maps[source], cells, width, layer.stride, weights, bias, sums, np.float32(floor), begin, end
            )
            bias = bias[:0]

    cost = len(cells) * sum(weights.size for weights in layer.weights)
    run_in_parts(compute, len(cells), cost // MIN_PER_PART)
    return Map(index, rows)


def _enlarge_map(small_map: Map, margin: int, grid: Grid) -> Map:
    """Enlarge the map of an empty cloud from a small grid to a larger one."""
    source_cells, positions = zip(
        *(_map_axis_cells(size, padded_size - 2, margin) for size, padded_size in zip(grid, small_map.row_index.shape))
    )
    rows = small_map.rows[small_map.row_index[1:-1, 1:-1][np.ix_(*source_cells)]].reshape(-1, small_map.rows.shape[1])
    index = _make_blank_index(grid)
    index[1:-1, 1:-1] = 1 + positions[0][:, None] * len(source_cells[1]) + positions[1]
    return Map(index, np.concatenate([np.zeros_like(rows[:1]), rows]))


def _map_axis_cells(size: int, small_size: int, margin: int) -> tuple[np.ndarray, np.ndarray]:
    """Map the cells of one axis of a large grid to those of a small grid.

    Returns:
        Indices (K,) of the cells of the small grid to copy, and for each cell of the large grid its
        position in these indices, (size,).
    """
    if small_size <= 2 * margin:
        return np.arange(size), np.arange(size)
    source_cells = np.r_[: margin + 1, small_size - margin : small_size]
    cell = np.arange(size)
    return source_cells, np.where(cell < size - margin, np.minimum(cell, margin), cell - size + len(source_cells))
