"""Ground by the Patchwork++ library (Lee, Lim, Myung, IROS 2022), as in paper B's V1."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from lidar_perception.ground.params import PatchworkParams
from lidar_perception.types import InputError

_stdout_lock = threading.RLock()  # reentrant, because a caller may silence a whole run


def segment_by_patchwork(xyz: np.ndarray, intensity: np.ndarray | None, sensor_height: float,
                         params: PatchworkParams = PatchworkParams()) -> np.ndarray:
    """Segment the ground of finite points.

    The library's running average over clouds is reset, so that a cloud always has the same ground.

    Args:
        xyz: (N, 3) float32 with z up.
        intensity: (N,) float32 0..1, by which reflections are removed; None skips that.
        sensor_height: height of the sensor above the ground in metres.

    Returns:
        (N,) bool, True = ground.

    Raises:
        InputError: if the library is not installed.
    """
    try:
        import pypatchworkpp
    except ImportError:
        raise InputError("ground.method 'patchwork' needs the package pypatchworkpp: pip install "
                         "pypatchworkpp, or choose threshold or cloth") from None
    settings = make_library_settings(sensor_height, params)
    settings.enable_RNR = params.remove_reflections and intensity is not None
    points = np.empty((len(xyz), 4), np.float32)
    points[:, :3] = xyz
    points[:, 3] = 0.0 if intensity is None else intensity
    ground = np.zeros(len(xyz), bool)
    with silence_stdout():
        engine = pypatchworkpp.patchworkpp(settings)
        if len(xyz):
            engine.estimateGround(points)
            ground[engine.getGroundIndices()] = True
    return ground


def make_library_settings(sensor_height: float, params: PatchworkParams) -> Any:
    """Return the library's Parameters object."""
    import pypatchworkpp
    settings = pypatchworkpp.Parameters()
    settings.verbose = False
    settings.sensor_height = sensor_height
    settings.min_range, settings.max_range = params.min_range, params.max_range
    settings.th_dist, settings.th_seeds = params.inlier_distance, params.seed_distance
    settings.uprightness_thr = params.uprightness
    settings.enable_RNR = params.remove_reflections
    return settings


@contextmanager
def silence_stdout() -> Iterator[None]:
    """Discard output to file descriptor 1, to which C++ libraries write without sys.stdout."""
    with _stdout_lock:
        sys.stdout.flush()
        saved, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(null, 1)
            yield
        finally:
            os.dup2(saved, 1)
            os.close(saved)
            os.close(null)
