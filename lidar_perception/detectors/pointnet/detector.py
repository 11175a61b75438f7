"""A cloud in, boxes out: ground and clusters before the network, NMS after it (paper C)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.base import NetworkDetector
from lidar_perception.detectors.boxes import cars_on_points
from lidar_perception.detectors.calibration import calibrated
from lidar_perception.detectors.checkpoint import Header
from lidar_perception.detectors.contract import Found
from lidar_perception.detectors.devices import CPU, chosen_device
from lidar_perception.detectors.matrix_kernel import LANES
from lidar_perception.detectors.nms import suppressed
from lidar_perception.detectors.pointnet.clusters import Clusters, clusters_of
from lidar_perception.detectors.pointnet.compiled import CompiledPointNet
from lidar_perception.detectors.pointnet.network import PointNet, fused, load_pointnet
from lidar_perception.detectors.pointnet.params import STEPS, PointNetDetectorParams, PointNetParams
from lidar_perception.detectors.pointnet.predict import Predictions, found, predict
from lidar_perception.detectors.pointnet.weights_file import weights_file
from lidar_perception.detectors.view import (
    as_found,
    levelled,
    levelled_ground,
    made_up_frame,
    with_intensity_scaled,
)
from lidar_perception.types import LidarFrame


class PointNetDetector(NetworkDetector):
    """Paper C's detector, see contract.py. The whole cloud is looked at.

    network: as loaded or trained; its norms are folded into its layers, in place.
    """

    def __init__(self, network: PointNet, header: Header, device: torch.device = CPU,
                 params: PointNetDetectorParams = PointNetDetectorParams()):
        super().__init__(header, device, params)
        self.network = fused(network)
        self.compiled = (CompiledPointNet(self.network)
                         if LANES and params.pointnet.engine == "auto" else None)
        self.network.to(device)

    @property
    def settings(self) -> PointNetParams:
        """The detector's own group of params."""
        return self.params.pointnet

    def detect(self, frame: LidarFrame, ground: np.ndarray | None,
               cluster_ids: np.ndarray | None) -> Found:
        """Ground and clusters are computed where they are None."""
        t0 = perf_counter()
        pose = self.params.ground.sensor_pose
        seen = with_intensity_scaled(levelled(frame, pose), self.settings.intensity_scale)
        t1 = perf_counter()
        if ground is None:
            ground = levelled_ground(seen, self.params.ground)
        ground = np.asarray(ground, bool)
        t2 = perf_counter()
        if cluster_ids is None:
            cluster_ids = cluster_obstacles(seen.xyz, ground, self.params.clustering,
                                            frame.xyz)
        t3 = perf_counter()
        clusters = clusters_of(seen, cluster_ids, self.settings.min_points)
        most = self.settings.max_clusters
        left_out = max(len(clusters) - most, 0)
        clusters = clusters.nearest(most).on(seen.xyz.compress(ground, axis=0))
        t4 = self.now()
        predicted = self.predict(clusters)
        t5 = self.now()
        detections, best, broken = self._detections(predicted)
        boxes = cars_on_points(detections.boxes, detections.class_ids,
                               seen.xyz.compress(~ground, axis=0), self.settings.on_points)
        detections = as_found(replace(detections, boxes=boxes.astype(np.float32)), pose)
        t6 = perf_counter()
        ms = {step: seconds * 1e3 for step, seconds in zip(
            STEPS, (t1 - t0 + t4 - t3, t2 - t1, t3 - t2, t5 - t4, t6 - t5))}
        problem = broken or self._problem(frame, cluster_ids, clusters, left_out) or self.fallback
        return Found(detections, ms, problem, best)

    def predict(self, clusters: Clusters, labels: np.ndarray | None = None) -> Predictions:
        """Return predict.predict() of the network where it runs now."""
        def run() -> Predictions:
            compiled = self.compiled if self.device == CPU else None
            return predict(compiled or self.network, clusters, labels=labels)

        return self.guarded(run)

    def _detections(self, predicted: Predictions) -> tuple:
        """Detections, and what nothing_passed gives."""
        settings, broken = self.settings, None
        best: dict[str, float] = {}
        sound = np.isfinite(np.column_stack([predicted.probabilities, predicted.boxes])).all(axis=1)
        if not sound.all():
            broken = ("the network's outputs are not numbers (NaN) for "
                      f"{len(sound) - sound.sum()} of {len(sound)} clusters; the weights or the "
                      "intensity are broken")
        predicted = predicted.take(np.flatnonzero(sound))
        detections = calibrated(
            found(predicted, self.config, self.raw_min_scores(), settings.nms),
            self.header.calibration)
        if len(detections) == 0 and sound.any():
            highest = predicted.probabilities[:, :len(self.classes)].max(axis=0)
            best, nan = self.nothing_passed(highest.tolist())
            broken = nan or broken
        return detections, best, broken

    def _problem(self, frame: LidarFrame, cluster_ids: np.ndarray, clusters: Clusters,
                 left_out: int) -> str | None:
        if len(frame) == 0:
            return "the cloud is empty or has no finite point, or crop.* leaves none"
        if not (cluster_ids > 0).any():
            return ("no clusters; are ground.sensor_pose, and the numbers of clustering.euclidean "
                    "or clustering.dbscan, right for this sensor?")
        if len(clusters) == 0:
            return (f"every cluster has fewer than {self.settings.min_points} points; lower "
                    "pointnet.min_points")
        if left_out:
            return (f"{left_out} of {len(clusters) + left_out} clusters are left out, the "
                    "farthest; raise clustering's min_size or pointnet.max_clusters")
        return self.no_intensity(frame)

    def bring_to(self, device: torch.device) -> None:
        """Bring the network to a device."""
        self.network.to(device)

    def warm_up(self) -> None:
        """Run every part once on made-up points, so that what is compiled is compiled."""
        scan = made_up_frame(self.params.ground.sensor_pose)
        self(scan)
        self(scan, cluster_ids=np.arange(len(scan)) // 20)
        suppressed(np.ones((2, 7)), np.ones(2), np.zeros(2, int), 0.5)


def load_pointnet_detector(path: str | Path = "", device: str = "auto",
                           params: PointNetDetectorParams | None = None) -> PointNetDetector:
    """A detector from a checkpoint; with an empty path the one that params name, or else the one
    that comes with the package. Without params it finds ground and clusters as the network was
    trained with. InputError where the checkpoint is missing or not of a PointNet, or device is not
    there."""
    settings = PointNetParams() if params is None else params.pointnet
    path = Path(path) if str(path) not in ("", ".") else weights_file(settings)
    if settings.threads:
        torch.set_num_threads(settings.threads)
    where = chosen_device(device)
    header, network = load_pointnet(path)
    if params is None:
        params = PointNetDetectorParams(ground=header.config.ground,
                                        clustering=header.config.clustering)
    detector = PointNetDetector(network, header, CPU, params)
    detector.move(where)
    if settings.warm_up:
        detector.warm_up()
    return detector
