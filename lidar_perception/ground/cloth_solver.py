"""Multigrid solver of the obstacle problem: a loaded sheet at rest under obstacles.

Each height of a grid (R, C) obeys height <= obstacle, and either touches its obstacle or is at the
mean of its four neighbours plus its lift. Beyond the border the sheet is level. A smoothing pass
moves near neighbours only, but coarser grids move distant cells, so a few cycles suffice (Brandt
and Cryer, SIAM J. Sci. Stat. Comput. 4(4), 1983).

Arrays in this module have a border of one cell. "Unobserved" cells have no obstacle (inf).
"""

from __future__ import annotations

import numpy as np
from numba import njit

SWEEPS = 2  # sweeps before and after each correction
COARSEST_SWEEPS = 40  # sweeps on the coarsest grid, which is about ten cells wide
RELAXATION = 1.5  # over-relaxation factor on the coarsest grid
MAX_CYCLES = 30  # five to seven are typical


def settle_sheet(obstacle: np.ndarray, lift: float, tolerance: float, levels: int) -> np.ndarray:
    """Return the heights (R, C) float32 of the sheet at rest.

    Args:
        obstacle: (R, C) float32, inf where there is none, with at least one finite value; R and C
            are multiples of 2 ** (levels - 1).
        lift: metres by which the load raises a free cell above the mean of its neighbours. Cells
            without an obstacle are not loaded, so that the sheet is straight across them.
        tolerance: the sheet is at rest when a sweep moves no observed cell farther, in metres.
        levels: number of grids.
    """
    obstacles = [obstacle]
    while len(obstacles) < levels:
        rows, columns = obstacles[-1].shape
        obstacles.append(obstacles[-1].reshape(rows // 2, 2, columns // 2, 2).min(axis=(1, 3)))
    sheet = np.zeros(0, np.float32)
    for level in range(levels - 1, -1, -1):
        above = np.pad(obstacles[level], 1, constant_values=np.inf)
        loads = np.where(np.isfinite(above), np.float32(lift * 4**level), np.float32(0))
        if level == levels - 1:
            sheet = np.minimum(np.float32(obstacles[-1].min()), above)
        else:
            sheet = _refine(sheet, above)
        for _ in range(MAX_CYCLES if level == 0 else 2):
            if _run_cycle(sheet, above, loads, levels - 1 - level) <= tolerance:
                break
    return sheet[1:-1, 1:-1].copy()


def _run_cycle(sheet: np.ndarray, above: np.ndarray, lift: np.ndarray, coarser: int) -> float:
    """Run one V-cycle in place; return how far the last sweep moved a cell, in metres.

    coarser is the number of coarser grids.
    """
    if coarser == 0:
        return _smooth(sheet, above, lift, COARSEST_SWEEPS, np.float32(RELAXATION))
    _smooth(sheet, above, lift, SWEEPS, np.float32(1.0))
    gap, rest = _restrict_residual(sheet, above, lift)
    correction = np.zeros_like(gap)
    _run_cycle(correction, gap, rest, coarser - 1)
    _add_correction(correction, sheet, above)
    return _smooth(sheet, above, lift, SWEEPS, np.float32(1.0))


def _refine(sheet: np.ndarray, above: np.ndarray) -> np.ndarray:
    finer = np.zeros_like(above)
    _add_correction(sheet, finer, above)
    return finer


@njit(cache=True, nogil=True)
def _smooth(sheet, above, lift, sweeps, relaxation):
    """Smooth by projected Gauss-Seidel in red-black order.

    Return how far the last sweep moved an observed cell, in metres.
    """
    rows, columns = sheet.shape
    quarter, moved = np.float32(0.25), np.float32(0.0)
    for _ in range(sweeps):
        moved = np.float32(0.0)
        for colour in range(2):
            _extend_border(sheet)
            for r in range(1, rows - 1):
                for c in range(1 + (r + colour) % 2, columns - 1, 2):
                    old = sheet[r, c]
                    free = (
                        quarter * (sheet[r - 1, c] + sheet[r + 1, c] + sheet[r, c - 1] + sheet[r, c + 1]) + lift[r, c]
                    )
                    new = min(old + relaxation * (free - old), above[r, c])
                    if above[r, c] < np.inf:
                        moved = max(moved, abs(new - old))
                    sheet[r, c] = new
    _extend_border(sheet)
    return moved


@njit(cache=True, nogil=True)
def _extend_border(sheet):
    rows, columns = sheet.shape
    for c in range(columns):
        sheet[0, c], sheet[rows - 1, c] = sheet[1, c], sheet[rows - 2, c]
    for r in range(rows):
        sheet[r, 0], sheet[r, columns - 1] = sheet[r, 1], sheet[r, columns - 2]


@njit(cache=True, nogil=True)
def _restrict_residual(sheet, above, lift):
    """Return the correction's problem on the next coarser grid: its obstacle and its lift.

    The obstacle is the smallest gap of each four cells; the lift is the sum of their residuals.
    """
    rows, columns = (sheet.shape[0] - 2) // 2, (sheet.shape[1] - 2) // 2
    gap = np.full((rows + 2, columns + 2), np.inf, np.float32)
    rest = np.zeros((rows + 2, columns + 2), np.float32)
    quarter = np.float32(0.25)
    for r in range(1, rows + 1):
        for c in range(1, columns + 1):
            for i in range(2 * r - 1, 2 * r + 1):
                for j in range(2 * c - 1, 2 * c + 1):
                    room = above[i, j] - sheet[i, j]
                    gap[r, c] = min(gap[r, c], room)
                    left = (
                        quarter * (sheet[i - 1, j] + sheet[i + 1, j] + sheet[i, j - 1] + sheet[i, j + 1])
                        + lift[i, j]
                        - sheet[i, j]
                    )
                    rest[r, c] += left
    return gap, rest


@njit(cache=True, nogil=True)
def _add_correction(coarse, sheet, above):
    """Add coarse, interpolated bilinearly, to the sheet, up to the obstacles `above`."""
    rows, columns = sheet.shape
    _extend_border(coarse)
    near, side, far = np.float32(9 / 16), np.float32(3 / 16), np.float32(1 / 16)
    for i in range(1, rows - 1):
        r = (i + 1) // 2
        other_r = r - 1 if i % 2 else r + 1
        for j in range(1, columns - 1):
            c = (j + 1) // 2
            other_c = c - 1 if j % 2 else c + 1
            value = (
                near * coarse[r, c] + side * (coarse[other_r, c] + coarse[r, other_c]) + far * coarse[other_r, other_c]
            )
            sheet[i, j] = min(sheet[i, j] + value, above[i, j])
