"""Parameters of the detector: flags, ROS parameters and docs are made from these fields."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import Params, param
from lidar_perception.params import ClusteringParams, DbscanParams, GroundParams, InputParams

STEPS = ("preprocess", "experts", "network", "postprocess")  # of which each has its time


@dataclass(frozen=True)
class ScoreParams(Params):
    """The least score of a detection, by class."""

    car: float = param(0.3, "Least score of a Car.", low=0.0, high=1.0)
    pedestrian: float = param(0.3, "Least score of a Pedestrian.", low=0.0, high=1.0)
    cyclist: float = param(0.3, "Least score of a Cyclist.", low=0.0, high=1.0)
    other: float = param(0.3, "Least score of any other class of the weights.", low=0.0, high=1.0)

    def of_class(self, name: str) -> float:
        """The threshold of a class of types.CLASSES."""
        return getattr(self, name.lower(), self.other)


@dataclass(frozen=True)
class NmsParams(Params):
    """Non-maximum suppression: of boxes that overlap, seen from above, the best stays."""

    iou: float = param(0.1, "A box that overlaps a better one by more than this is dropped.",
                       low=0.0, high=1.0)
    across_classes: bool = param(False, "Boxes of different classes compete too.")
    candidates: int = param(500, "The best this many boxes take part.", low=1, high=10_000)
    max_boxes: int = param(100, "The best this many are kept.", low=1, high=10_000)


@dataclass(frozen=True)
class NetworkParams(Params):
    """Where a detector's network runs, and what counts as found."""

    weights: str = param("", "Checkpoint (.safetensors); empty: the one that comes with the "
                         "package.", fixed=True)
    device: str = param("auto", "cpu, cuda or cuda:N; auto: CUDA where there is one.", fixed=True)
    threads: int = param(0, "CPU threads of the network; fewer leave room for other programs. "
                         "0 takes one for each core.", low=0, high=1024, fixed=True)
    cpu_fallback: bool = param(True, "Go on with the CPU when CUDA runs out of memory; a node also "
                               "where there is no CUDA at all.")
    warm_up: bool = param(True, "Run once on made-up points before the first cloud.", fixed=True)
    intensity_scale: float = param(1.0, "Factor on the intensity (0..1) before the network, for a "
                                   "sensor that reports more or less than the one trained on; 0 "
                                   "leaves the intensity out.", low=0.0, high=1000.0)
    scores: ScoreParams = ScoreParams()
    nms: NmsParams = NmsParams()


@dataclass(frozen=True)
class DetectionParams(NetworkParams):
    """Which PointPillars, where it runs, and what counts as found."""

    weights: str = param("", "Checkpoint (.safetensors) or exported network (.onnx); empty: the "
                         "one that comes with the package.", fixed=True)
    version: str = param("auto", "EG-PointPillars version: v0 (PointPillars), v1 ... v4. auto: "
                         "what the weights are; v4 without weights.",
                         choices=("auto", "v0", "v1", "v2", "v3", "v4"), fixed=True)
    size: str = param("auto", "full: the paper's network, for a GPU. compact: for two CPU cores. "
                      "auto: what the weights are; compact without weights.",
                      choices=("auto", "full", "compact"), fixed=True)


# The experts of paper B: Patchwork++ and DBSCAN, of which it gives no numbers. Ours, chosen on
# simulated scans, keep cars in one piece; paper A's, which are for pedestrians, break them up.
EXPERT_GROUND = GroundParams(method="patchwork")
EXPERT_CLUSTERING = ClusteringParams(dbscan=DbscanParams(eps=(0.5, 0.7, 1.0), min_samples=5))
INPUT = InputParams()


@dataclass(frozen=True)
class DetectorParams:
    """All groups of the detector; ground and clustering are its experts."""

    input: InputParams = INPUT
    ground: GroundParams = EXPERT_GROUND
    clustering: ClusteringParams = EXPERT_CLUSTERING
    detection: DetectionParams = DetectionParams()
