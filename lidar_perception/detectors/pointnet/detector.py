"""PointNet detector: ground segmentation, clustering, network and NMS (paper C)."""

from __future__ import annotations

import copy
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from lidar_perception.clustering.cluster import cluster_obstacles
from lidar_perception.detectors.base import NetworkDetector, make_synthetic_frame
from lidar_perception.detectors.boxes import move_cars_to_points
from lidar_perception.detectors.calibration import calibrate_scores
from lidar_perception.detectors.checkpoint import Header, read_arrays
from lidar_perception.detectors.contract import DetectionResult
from lidar_perception.detectors.devices import CPU, find_device
from lidar_perception.detectors.layer_weights import WeightsMismatch
from lidar_perception.detectors.matrix_kernel import LANES
from lidar_perception.detectors.nms import rotated_nms
from lidar_perception.detectors.normalized_view import NormalizedView, restore_detections, segment_view_ground
from lidar_perception.detectors.pointnet.classifier import PointNetClassifier
from lidar_perception.detectors.pointnet.clusters import Clusters, make_clusters
from lidar_perception.detectors.pointnet.compiled import CompiledPointNet
from lidar_perception.detectors.pointnet.config import PointNetConfig
from lidar_perception.detectors.pointnet.params import STEPS, PointNetDetectorParams, PointNetParams
from lidar_perception.detectors.pointnet.predict import Network, Predictions, select_detections
from lidar_perception.detectors.weights_file import find_pointnet_weights
from lidar_perception.runs.threads import set_thread_count
from lidar_perception.types import EMPTY_CLOUD, Detections, InputError, PointCloud


class PointNetDetector(NetworkDetector):
    """The improved PointNet as a detector, see contract.Detector. It covers the whole cloud.

    If a call passes no ground or no clusters, they are computed.
    """

    group = "pointnet"
    params: PointNetDetectorParams

    def __init__(self, classifier: PointNetClassifier, params: PointNetDetectorParams = PointNetDetectorParams()):
        super().__init__(params)
        self.classifier = classifier

    @property
    def networks(self) -> tuple[PointNetClassifier]:
        return (self.classifier,)

    @property
    def settings(self) -> PointNetParams:
        return self.params.pointnet

    def with_raw_scores(self) -> PointNetDetector:
        other = copy.copy(self)
        other.classifier = self.classifier.with_raw_scores()
        return other

    def detect(self, frame: PointCloud, ground: np.ndarray | None, cluster_ids: np.ndarray | None) -> DetectionResult:
        t0 = perf_counter()
        settings = self.settings
        view = NormalizedView.of(frame, self.params.ground.sensor_pose, use_intensity=settings.use_intensity)
        t1 = perf_counter()
        if ground is None:
            ground = segment_view_ground(view.frame, self.params.ground)
        t2 = perf_counter()
        if cluster_ids is None:
            cluster_ids = cluster_obstacles(view.frame, ground, self.params.clustering, view.source.xyz)
        t3 = perf_counter()
        clusters = make_clusters(view.frame, cluster_ids, settings.min_points)
        ignored_count = max(len(clusters) - settings.max_clusters, 0)
        clusters = clusters.take_nearest(settings.max_clusters).with_ground(view.frame.xyz.compress(ground, axis=0))
        t4 = self.classifier.get_time()
        predictions = self.classifier.predict(clusters, cpu_fallback=settings.cpu_fallback)
        t5 = self.classifier.get_time()
        detections, best_scores, output_problem = self._make_detections(predictions)
        boxes = move_cars_to_points(
            detections.boxes, detections.class_ids, view.frame.xyz.compress(~ground, axis=0), settings.on_points
        )
        detections = restore_detections(replace(detections, boxes=boxes.astype(np.float32)), view.pose)
        t6 = perf_counter()
        timings = {
            step: seconds * 1e3 for step, seconds in zip(STEPS, (t1 - t0 + t4 - t3, t2 - t1, t3 - t2, t5 - t4, t6 - t5))
        }
        problem = output_problem or self._find_problem(view, cluster_ids, clusters, ignored_count)
        return DetectionResult(detections, timings, problem or self.fallback, best_scores)

    def _make_detections(self, predictions: Predictions) -> tuple[Detections, dict[str, float], str | None]:
        """Return the detections, the best score of each class if there are none, and a problem or None."""
        output_problem = None
        best_scores: dict[str, float] = {}
        is_finite = np.isfinite(np.column_stack([predictions.probabilities, predictions.boxes])).all(axis=1)
        if not is_finite.all():
            output_problem = (
                f"the network's outputs are NaN for {len(is_finite) - is_finite.sum()} of "
                f"{len(is_finite)} clusters; check the weights and the intensity"
            )
        predictions = predictions.take(np.flatnonzero(is_finite))
        detections = calibrate_scores(
            select_detections(
                predictions, self.classifier.config, self.classifier.to_raw_scores(self.min_scores), self.settings.nms
            ),
            self.classifier.header.calibration,
        )
        if len(detections) == 0 and is_finite.any():
            class_scores = predictions.probabilities[:, : len(self.classes)].max(axis=0)
            best_scores, score_problem = self.classifier.find_best_scores(class_scores.tolist())
            output_problem = score_problem or output_problem
        return detections, best_scores, output_problem

    def _find_problem(
        self, view: NormalizedView, cluster_ids: np.ndarray, clusters: Clusters, ignored_count: int
    ) -> str | None:
        if len(view.source) == 0:
            return EMPTY_CLOUD
        if not (cluster_ids > 0).any():
            return (
                "no clusters found; check ground.sensor_pose, and adapt clustering.euclidean or clustering.dbscan to "
                "this sensor"
            )
        if len(clusters) == 0:
            return f"all clusters have fewer than {self.settings.min_points} points; lower pointnet.min_points"
        if ignored_count:
            return (
                f"the farthest {ignored_count} of {len(clusters) + ignored_count} clusters are ignored; "
                "raise clustering's min_size or pointnet.max_clusters"
            )
        return view.find_intensity_problem()

    def warm_up(self) -> None:
        """Run every step once on synthetic points to trigger JIT compilation."""
        scan = make_synthetic_frame(self.params.ground.sensor_pose)
        self(scan)
        self(scan, cluster_ids=np.arange(len(scan)) // 20)
        rotated_nms(np.ones((2, 7)), np.ones(2), np.zeros(2, int), 0.5)


def load_pointnet_detector(
    path: str | Path = "", device: str = "auto", params: PointNetDetectorParams | None = None
) -> PointNetDetector:
    """Load a detector from a checkpoint (.safetensors) or an exported network (.onnx).

    Args:
        path: weights file; empty: `params.pointnet.weights`, by default the shipped file.
        params: None: defaults with the ground and clustering parameters that the network was
            trained with.

    Raises:
        InputError: the file is missing or not a PointNet, or the device does not exist.
    """
    settings = PointNetParams() if params is None else params.pointnet
    path = Path(path) if str(path) not in ("", ".") else find_pointnet_weights(settings)
    if settings.threads:
        set_thread_count(settings.threads)
    target = CPU if path.suffix == ".onnx" and device == "auto" else find_device(device)
    header, network = _load_network(path, target, settings.engine)
    if params is None:
        params = PointNetDetectorParams(ground=header.config.ground, clustering=header.config.clustering)
    classifier = PointNetClassifier(network, header)
    classifier.move(target, settings.cpu_fallback)
    detector = PointNetDetector(classifier, params)
    if settings.warm_up:
        detector.warm_up()
    return detector


def _load_network(path: Path, device: str, engine: str) -> tuple[Header, Network]:
    """Load a checkpoint or an exported network. torch is used only if compiled kernels cannot run it."""
    if path.suffix == ".onnx":
        from lidar_perception.detectors.pointnet.onnx import OnnxPointNet

        if device != CPU:
            raise InputError(
                f"{path} runs in ONNX Runtime on the CPU, not on {device!r}; use the checkpoint it was exported from"
            )
        exported_network = OnnxPointNet(path)
        return exported_network.header, exported_network
    if device == CPU and engine == "auto" and LANES:
        with suppress(WeightsMismatch):  # load_pointnet() below reports the mismatch
            header, tensors = read_arrays(path, PointNetConfig)
            return header, CompiledPointNet(header.config, tensors)
    from lidar_perception.detectors.pointnet.network import fuse_norms, load_pointnet
    from lidar_perception.detectors.pointnet.torch_network import TorchPointNet

    header, network = load_pointnet(path)
    return header, TorchPointNet(fuse_norms(network), engine)
