"""Peers: implementations in other packages, some of which may not be installed."""

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
    """An algorithm from another package.

    Attributes:
        name: Name in tables.
        package: Name on PyPI.
        module: Name of the module to import.
        run: Function that runs it; the comment above each section of this module gives the signature.
    """

    name: str
    package: str
    module: str
    run: Callable

    def find_problem(self) -> str:
        """Return the reason why the peer cannot run here, or ""."""
        try:
            importlib.import_module(self.module)
        except ModuleNotFoundError:
            return "not installed"
        except (ImportError, OSError):  # a system library is missing
            return "cannot be imported"
        return ""

    def read_version(self) -> str:
        return self.find_problem() or metadata.version(self.package)


# DBSCAN: points (N, 3) float32, eps, min_samples -> (N,) labels, -1 for noise.


def _make_sklearn_dbscan(jobs: int | None) -> Callable:
    def run(xyz, eps, min_samples):
        from sklearn.cluster import DBSCAN

        return DBSCAN(eps=eps, min_samples=min_samples, n_jobs=jobs).fit(xyz).labels_

    return run


def _run_dbscan_wheel(xyz, eps, min_samples):
    from dbscan import DBSCAN

    return DBSCAN(xyz.astype(np.float64), eps, min_samples)[0]


def _run_open3d_dbscan(xyz, eps, min_samples):
    import open3d

    points = open3d.utility.Vector3dVector(xyz.astype(np.float64))
    return np.asarray(open3d.geometry.PointCloud(points).cluster_dbscan(eps, min_samples))


SKLEARN = (
    Peer("scikit-learn", "scikit-learn", "sklearn", _make_sklearn_dbscan(None)),
    Peer("sklearn, n_jobs=-1", "scikit-learn", "sklearn", _make_sklearn_dbscan(-1)),
)
OPEN3D = Peer("Open3D", "open3d", "open3d", _run_open3d_dbscan)
# Runs in a separate process: its threads poll after the call and use a quarter of a core until the process ends.
WHEEL = Peer("dbscan", "dbscan", "dbscan", _run_dbscan_wheel)
DBSCANS = (*SKLEARN, WHEEL, OPEN3D)


def cluster_by_bands(run: Callable, xyz: np.ndarray, params: DbscanParams = DbscanParams()) -> np.ndarray:
    """Cluster each range band with a DBSCAN. Return labels (N,) as distance_aware_dbscan does; 0 is noise."""
    band = np.searchsorted(np.asarray(params.range_limits), horizontal_range(xyz), side="right")
    labels, max_label = np.zeros(len(xyz), np.int32), 0
    for i, eps in enumerate(params.eps):
        members = np.flatnonzero(band == i)
        if len(members):
            band_labels = run(xyz[members], eps, params.min_samples)
            labels[members] = np.where(band_labels >= 0, band_labels + max_label + 1, 0)
            max_label += int(band_labels.max()) + 1
    return labels


# RANSAC: points (N, 3), mask (N,) of low points to fit a plane to -> ground mask (N,).

MAX_TRIALS = 2000  # maximum number of trials, as in paper A


def _run_ransac(xyz: np.ndarray, low: np.ndarray) -> np.ndarray:
    from sklearn.linear_model import LinearRegression, RANSACRegressor

    model = RANSACRegressor(LinearRegression(), max_trials=MAX_TRIALS, residual_threshold=0.1, random_state=0).fit(
        xyz[low, :2], xyz[low, 2]
    )
    return np.abs(xyz[:, 2] - model.predict(xyz[:, :2])) <= 0.1


RANSAC = Peer("scikit-learn's RANSAC", "scikit-learn", "sklearn", _run_ransac)


# Ground segmentation. Both libraries print to file descriptor 1.


@contextmanager
def silence_stdout() -> Iterator[None]:
    """Discard output to file descriptor 1, to which C++ libraries write directly."""
    sys.stdout.flush()
    stdout_copy, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        yield
    finally:
        os.dup2(stdout_copy, 1)
        os.close(stdout_copy)
        os.close(null)


def _run_patchwork(points: np.ndarray, sensor_height: float, params: PatchworkParams = PatchworkParams()) -> np.ndarray:
    """Return the indices of the ground among points (N, 4) float32. Makes a new object for each call."""
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


def _run_cloth(xyz: np.ndarray, params: ClothParams = ClothParams()):
    """Return the indices of the ground among points (N, 3) float64, as a vector of the library.

    Points must not be far away: the library aborts the process if its grid does not fit into memory.
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


PATCHWORK = Peer("pypatchworkpp", "pypatchworkpp", "pypatchworkpp", _run_patchwork)
CLOTH = Peer("cloth-simulation-filter", "cloth-simulation-filter", "CSF", _run_cloth)
ALL = (*DBSCANS, PATCHWORK, CLOTH)
