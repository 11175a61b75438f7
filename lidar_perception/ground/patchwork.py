"""Ground by Patchwork++ (Lee, Lim, Myung, IROS 2022), through its own library; paper B, V1."""

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

_redirecting = threading.RLock()  # a caller may silence a whole run


def segment_by_patchwork(xyz: np.ndarray, intensity: np.ndarray | None, sensor_height: float,
                         params: PatchworkParams = PatchworkParams()) -> np.ndarray:
    """(N,) bool, True = ground: of points (N, 3) float32, finite, with z up, sensor_height metres
    above the ground. intensity (N,) float32 0..1 serves to leave out reflections; None skips that.

    Each cloud is judged by itself: the library's running average over clouds starts anew, so that
    the same cloud always has the same ground. InputError where the library is not installed.
    """
    try:
        import pypatchworkpp
    except ImportError:
        raise InputError("ground.method 'patchwork' needs the package pypatchworkpp: pip install "
                         "pypatchworkpp, or choose threshold or cloth") from None
    settings = library_settings(sensor_height, params)
    settings.enable_RNR = params.remove_reflections and intensity is not None
    points = np.empty((len(xyz), 4), np.float32)
    points[:, :3] = xyz
    points[:, 3] = 0.0 if intensity is None else intensity
    ground = np.zeros(len(xyz), bool)
    with silent_stdout():
        engine = pypatchworkpp.patchworkpp(settings)
        if len(xyz):
            engine.estimateGround(points)
            ground[engine.getGroundIndices()] = True
    return ground


def library_settings(sensor_height: float, params: PatchworkParams) -> Any:
    """The library's own Parameters."""
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
def silent_stdout() -> Iterator[None]:
    """Libraries in C++ write to file descriptor 1, where sys.stdout has no say."""
    with _redirecting:
        sys.stdout.flush()
        kept, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, 1)
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)
            os.close(nowhere)
