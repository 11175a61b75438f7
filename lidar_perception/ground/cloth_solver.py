"""Multigrid solver for the obstacle problem: a loaded sheet at rest under obstacles.

Each height of a grid (R, C) obeys height <= obstacle. It either touches its obstacle or equals the
mean of its four neighbours plus its lift. Beyond the border, the sheet is level. A smoothing pass
affects only nearby cells, but coarser grids propagate it, so a few cycles suffice (Brandt and
Cryer, SIAM J. Sci. Stat. Comput. 4(4), 1983).

Arrays in this module have a border of one cell. "Unobserved" cells have no obstacle (inf).
"""

from __future__ import annotations

import numpy as np
from numba import njit

SWEEPS = 2  # sweeps before and after each correction
COARSEST_SWEEPS = 40  # sweeps on the coarsest grid, which is about ten cells wide
RELAXATION = 1.5  # over-relaxation factor on the coarsest grid
MAX_CYCLES = 30  # maximum number of V-cycles on the finest grid; five to seven are typical


def settle_sheet(obstacle: np.ndarray, lift: float, tolerance: float, levels: int) -> np.ndarray:
    """Compute the sheet at rest.

    Args:
        obstacle: (R, C) float32 height of each obstacle in metres, inf for none, with at least one
            finite value; R and C are multiples of 2 ** (levels - 1).
        lift: height in metres by which the load raises a free cell above the mean of its
            neighbours. Cells without an obstacle carry no load, so the sheet is straight there.
        tolerance: maximum movement of an observed cell in the last sweep, in metres.
        levels: number of grids.

    Returns:
        (R, C) float32 heights in metres.
    """
    obstacles = [obstacle]
    while len(obstacles) < levels:
        rows, columns = obstacles[-1].shape
        obstacles.append(obstacles[-1].reshape(rows // 2, 2, columns // 2, 2).min(axis=(1, 3)))
    sheet = np.zeros(0, np.float32)
    for level in range(levels - 1, -1, -1):
        padded_obstacle = np.pad(obstacles[level], 1, constant_values=np.inf)
        lifts = np.where(np.isfinite(padded_obstacle), np.float32(lift * 4**level), np.float32(0))
        if level == levels - 1:
            sheet = np.minimum(np.float32(obstacles[-1].min()), padded_obstacle)
        else:
            sheet = _refine(sheet, padded_obstacle)
        for _ in range(MAX_CYCLES if level == 0 else 2):
            if _run_cycle(sheet, padded_obstacle, lifts, levels - 1 - level) <= tolerance:
                break
    return sheet[1:-1, 1:-1].copy()


def _run_cycle(sheet: np.ndarray, obstacle: np.ndarray, lift: np.ndarray, coarser_levels: int) -> float:
    """Run one V-cycle in place; return the largest movement in the last sweep, in metres."""
    if coarser_levels == 0:
        return _smooth(sheet, obstacle, lift, COARSEST_SWEEPS, np.float32(RELAXATION))
    _smooth(sheet, obstacle, lift, SWEEPS, np.float32(1.0))
    gap, residual = _restrict_residual(sheet, obstacle, lift)
    correction = np.zeros_like(gap)
    _run_cycle(correction, gap, residual, coarser_levels - 1)
    _add_correction(correction, sheet, obstacle)
    return _smooth(sheet, obstacle, lift, SWEEPS, np.float32(1.0))


def _refine(sheet: np.ndarray, obstacle: np.ndarray) -> np.ndarray:
    refined_sheet = np.zeros_like(obstacle)
    _add_correction(sheet, refined_sheet, obstacle)
    return refined_sheet


@njit(cache=True, nogil=True)
def _smooth(sheet, obstacle, lift, sweeps, relaxation):
    """Smooth by projected Gauss-Seidel in red-black order.

    Returns the largest movement of an observed cell in the last sweep, in metres.
    """
    rows, columns = sheet.shape
    quarter, max_move = np.float32(0.25), np.float32(0.0)
    for _ in range(sweeps):
        max_move = np.float32(0.0)
        for colour in range(2):
            _extend_border(sheet)
            for r in range(1, rows - 1):
                for c in range(1 + (r + colour) % 2, columns - 1, 2):
                    old_height = sheet[r, c]
                    free_height = (
                        quarter * (sheet[r - 1, c] + sheet[r + 1, c] + sheet[r, c - 1] + sheet[r, c + 1]) + lift[r, c]
                    )
                    new_height = min(old_height + relaxation * (free_height - old_height), obstacle[r, c])
                    if obstacle[r, c] < np.inf:
                        max_move = max(max_move, abs(new_height - old_height))
                    sheet[r, c] = new_height
    _extend_border(sheet)
    return max_move


@njit(cache=True, nogil=True)
def _extend_border(sheet):
    rows, columns = sheet.shape
    for c in range(columns):
        sheet[0, c], sheet[rows - 1, c] = sheet[1, c], sheet[rows - 2, c]
    for r in range(rows):
        sheet[r, 0], sheet[r, columns - 1] = sheet[r, 1], sheet[r, columns - 2]


@njit(cache=True, nogil=True)
def _restrict_residual(sheet, obstacle, lift):
    """Return obstacle and lift of the correction on the next coarser grid.

    The obstacle is the smallest gap of four cells each; the lift is the sum of their residuals.
    """
    rows, columns = (sheet.shape[0] - 2) // 2, (sheet.shape[1] - 2) // 2
    gap = np.full((rows + 2, columns + 2), np.inf, np.float32)
    residual = np.zeros((rows + 2, columns + 2), np.float32)
    quarter = np.float32(0.25)
    for r in range(1, rows + 1):
        for c in range(1, columns + 1):
            for i in range(2 * r - 1, 2 * r + 1):
                for j in range(2 * c - 1, 2 * c + 1):
                    clearance = obstacle[i, j] - sheet[i, j]
                    gap[r, c] = min(gap[r, c], clearance)
                    cell_residual = (
                        quarter * (sheet[i - 1, j] + sheet[i + 1, j] + sheet[i, j - 1] + sheet[i, j + 1])
                        + lift[i, j]
                        - sheet[i, j]
                    )
                    residual[r, c] += cell_residual
    return gap, residual


@njit(cache=True, nogil=True)
def _add_correction(coarse, sheet, obstacle):
    """Interpolate `coarse` bilinearly and add it to the sheet, up to the obstacles."""
    rows, columns = sheet.shape
    _extend_border(coarse)
    near_weight, side_weight, far_weight = np.float32(9 / 16), np.float32(3 / 16), np.float32(1 / 16)
    for i in range(1, rows - 1):
        r = (i + 1) // 2
        other_r = r - 1 if i % 2 else r + 1
        for j in range(1, columns - 1):
            c = (j + 1) // 2
            other_c = c - 1 if j % 2 else c + 1
            correction = (
                near_weight * coarse[r, c]
                + side_weight * (coarse[other_r, c] + coarse[r, other_c])
                + far_weight * coarse[other_r, other_c]
            )
            sheet[i, j] = min(sheet[i, j] + correction, obstacle[i, j])
