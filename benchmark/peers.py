"""Thin wrappers of peers that are packages; a peer that is not installed reports it."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata

import numpy as np

from lidar_perception.clustering.params import DbscanParams
from lidar_perception.geometry import horizontal_range
from lidar_perception.ground.params import ClothParams, PatchworkParams


@dataclass(frozen=True)
class Peer:
    """An algorithm of a package; run has the signature of its kind, package is its name on PyPI."""

    name: str
    package: str
    module: str
    run: Callable

    def missing(self) -> str:
        """Reason why it cannot run here, empty if it can."""
        try:
            importlib.import_module(self.module)
        except ModuleNotFoundError:
            return "not installed"
        except (ImportError, OSError):  # a system library is missing
            return "cannot be imported"
        return ""

    def version(self) -> str:
        return self.missing() or metadata.version(self.package)


# DBSCAN: points (N, 3) float32, eps, min_samples -> (N,) labels, -1 for noise.


def _sklearn(jobs: int | None) -> Callable:
    def run(xyz, eps, min_samples):
        from sklearn.cluster import DBSCAN

        return DBSCAN(eps=eps, min_samples=min_samples, n_jobs=jobs).fit(xyz).labels_

    return run


def _wheel(xyz, eps, min_samples):
    from dbscan import DBSCAN

    return DBSCAN(xyz.astype(np.float64), eps, min_samples)[0]


def _open3d(xyz, eps, min_samples):
    import open3d

    points = open3d.utility.Vector3dVector(xyz.astype(np.float64))
    return np.asarray(open3d.geometry.PointCloud(points).cluster_dbscan(eps, min_samples))


SKLEARN = (
    Peer("scikit-learn", "scikit-learn", "sklearn", _sklearn(None)),
    Peer("sklearn, n_jobs=-1", "scikit-learn", "sklearn", _sklearn(-1)),
)
OPEN3D = Peer("Open3D", "open3d", "open3d", _open3d)
# Its threads keep polling after the call and use a quarter of a core until the process ends.
WHEEL = Peer("dbscan", "dbscan", "dbscan", _wheel)
DBSCANS = (*SKLEARN, WHEEL, OPEN3D)


def by_bands(run: Callable, xyz: np.ndarray, params: DbscanParams = DbscanParams()) -> np.ndarray:
    """Cluster band by band with a DBSCAN; labels (N,) as of distance_aware_dbscan, 0 noise."""
    band = np.searchsorted(np.asarray(params.range_limits), horizontal_range(xyz), side="right")
    labels, last = np.zeros(len(xyz), np.int32), 0
    for i, eps in enumerate(params.eps):
        members = np.flatnonzero(band == i)
        if len(members):
            found = run(xyz[members], eps, params.min_samples)
            labels[members] = np.where(found >= 0, found + last + 1, 0)
            last += int(found.max()) + 1
    return labels


# RANSAC: points (N, 3), mask (N,) of low points to fit a plane to -> ground mask (N,).

TRIALS = 2000  # maximum number of trials, as in paper A


def _ransac(xyz: np.ndarray, low: np.ndarray) -> np.ndarray:
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    found = RANSACRegressor(LinearRegression(), max_trials=TRIALS, residual_threshold=0.1, random_state=0).fit(
        xyz[low, :2], xyz[low, 2]
    )
    return np.abs(xyz[:, 2] - found.predict(xyz[:, :2])) <= 0.1


RANSAC = Peer("scikit-learn's RANSAC", "scikit-learn", "sklearn", _ransac)


# Ground segmentation. Both libraries print on file descriptor 1.


@contextmanager
def silence_stdout() -> Iterator[None]:
    """Discard output to file descriptor 1, to which C++ libraries write without sys.stdout."""
    sys.stdout.flush()
    saved, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
        os.close(null)


def _bare_patchwork(
    points: np.ndarray, sensor_height: float, params: PatchworkParams = PatchworkParams()
) -> np.ndarray:
    """Return the indices of the ground among points (N, 4) float32, by a new object."""
    import pypatchworkpp

    settings = pypatchworkpp.Parameters()
    settings.sensor_height = sensor_height
    settings.min_range, settings.max_range = params.min_range, params.max_range
    settings.th_dist, settings.th_seeds = params.inlier_distance, params.seed_distance
    settings.uprightness_thr = params.uprightness
    settings.enable_RNR = params.remove_reflections
    engine = pypatchworkpp.patchworkpp(settings)
    engine.estimateGround(points)
    return engine.getGroundIndices()


def _falling_cloth(xyz: np.ndarray, params: ClothParams = ClothParams()):
    """Return indices of the ground among points (N, 3) float64, as the wheel's own vector.

    No point may be far away: the wheel aborts the process if the grid does not fit into memory.
    Rigidness 3 and 500 iterations are its defaults.
    """
    import CSF

    cloth = CSF.CSF()
    cloth.params.bSloopSmooth = False
    cloth.params.cloth_resolution = params.resolution
    cloth.params.class_threshold = params.class_threshold
    cloth.params.rigidness, cloth.params.interations = 3, 500
    cloth.setPointCloud(xyz)
    ground, others = CSF.VecInt(), CSF.VecInt()
    cloth.do_filtering(ground, others, False)
    return ground


PATCHWORK = Peer("pypatchworkpp", "pypatchworkpp", "pypatchworkpp", _bare_patchwork)
CLOTH = Peer("cloth-simulation-filter", "cloth-simulation-filter", "CSF", _falling_cloth)
ALL = (*DBSCANS, PATCHWORK, CLOTH)
