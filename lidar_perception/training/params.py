"""Parameters of training: flags and docs are made from these fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lidar_perception.detectors.params import seen_range
from lidar_perception.param_fields import Params, flatten, param

INDIFFERENT = ("log_steps", "save_steps", "max_skipped", "data.cache", "data.cache_gb")
PAPER_SHARE = 751 / 7518  # of the frames that paper B holds out


@dataclass(frozen=True)
class LoopParams(Params):
    """How long, how fast, and how often something is written."""

    steps: int = param(0, "Steps of the optimizer. 0: as many as the epochs have, or the budget.",
                       low=0, high=10**9)
    epochs: float = param(0.0, "Passes over the data, if steps is 0. 0: the budget decides.",
                          low=0.0, high=1e5)
    batch: int = param(4, "Scenes in a step, on each device.", low=1, high=4096)
    lr: float = param(0.003, "Highest learning rate.", low=1e-9, high=10.0)
    warm_share: float = param(0.4, "Share of the steps during which the learning rate rises; then "
                                   "it falls.", low=0.01, high=0.99)
    weight_decay: float = param(0.01, "Weight decay of AdamW.", low=0.0, high=1.0)
    clip: float = param(10.0, "Largest norm of the gradient; larger ones are clipped. 0: none.",
                        low=0.0, high=1e6)
    ema: float = param(0.999, "Decay of the moving average of the weights, which is validated "
                       "and saved. 0: the weights themselves.", low=0.0,
                       high=0.999999)
    amp: str = param("auto", "Number format of the forward pass. auto: bf16 where the device has "
                     "instructions for it, which takes half the time on the CPU; else fp16 on "
                     "CUDA, float32 on the CPU.",
                     choices=("auto", "bf16", "fp16", "off"))
    validate_epochs: float = param(0.0, "Epochs between validations, if validate_steps is 0. 0: "
                                   "the budget decides.", low=0.0, high=1e5)
    validate_steps: int = param(0, "Steps between validations; 0: validate_epochs decides.",
                                low=0, high=10**9)
    save_steps: int = param(200, "Steps between saves of the state that a resumed run needs.",
                            low=1, high=10**9)
    log_steps: int = param(10, "Steps between logged losses.", low=1, high=10**6)
    max_skipped: int = param(50, "Give up after this many consecutive steps whose loss or "
                              "gradient is not finite.", low=1, high=10**6)
    seed: int = param(0, "Seed of the weights, the order of the scenes and their augmentation.",
                      low=0, high=2**31 - 1)

    def decisive(self) -> dict[str, Any]:
        """{dotted name: value} of what a run cannot change while it is interrupted."""
        return {name: value for name, value in flatten(self).items() if name not in INDIFFERENT}

    def total_steps(self, epoch: int) -> int:
        """Steps in all, if an epoch has so many; 0 where the budget decides."""
        return self.steps or (max(1, round(self.epochs * epoch)) if self.epochs else 0)

    def validation_steps(self, epoch: int) -> int:
        """Steps from one validation to the next; 0 where the budget decides."""
        return self.validate_steps or (max(1, round(self.validate_epochs * epoch))
                                       if self.validate_epochs else 0)


@dataclass(frozen=True)
class NoiseParams(Params):
    """How far off the ranges are."""

    beam_noise: float = param(0.08, "Error of the ranges that all points of a beam share; standard "
                              "deviation, at most.", unit="m", low=0.0, high=1.0)
    range_noise: float = param(0.08, "Error of the range of each point, likewise.", unit="m",
                               low=0.0, high=1.0)


@dataclass(frozen=True)
class ThingParams(NoiseParams):
    """How background is changed that is taken for objects."""

    things_stretch: float = param(0.5, "Pasted background is stretched or shrunk, in width and "
                                       "height, by factors of up to exp(this).", low=0.0, high=3.0)
    things_intensity: float = param(0.8, "Their intensities are multiplied or divided by up to "
                                         "exp(this).", low=0.0, high=3.0)
    things_shine: float = param(0.25, "Probability that a part of such a thing is "
                                      "retroreflective, as signs are.", low=0.0, high=1.0)


@dataclass(frozen=True)
class AugmentParams(ThingParams):
    """How scenes are changed. 0 switches a change off."""

    crowded: float = param(0.7, "Probability that objects from other scenes are pasted into a "
                                "scene.", low=0.0, high=1.0)
    cars: int = param(10, "Cars from other scenes are pasted in until there are this many in the "
                          "network's range.", low=0, high=100)
    pedestrians: int = param(8, "Likewise pedestrians.", low=0, high=100)
    cyclists: int = param(8, "Likewise cyclists.", low=0, high=100)
    things: int = param(12, "This many objects that resemble a standing person, such as posts, are "
                        "pasted in as background.", low=0, high=100)
    database_scans: int = param(500, "Pasted objects come from at most this many scenes.", low=0,
                                high=10**6)
    object_turn: float = param(0.157, "Each object is rotated by up to this.", unit="rad", low=0.0,
                               high=3.1416)
    object_shift: float = param(0.25, "Each object is shifted along x and y; standard deviation.",
                                unit="m", low=0.0, high=5.0)
    flip: float = param(0.5, "Probability that left and right are swapped.", low=0.0, high=1.0)
    turn: float = param(0.785, "The scene is rotated about the sensor by up to this; by any angle "
                               "if it is labelled all around, unless this is 0.",
                        unit="rad", low=0.0, high=3.1416)
    scale: float = param(0.05, "The scene is scaled by up to this share.", low=0.0, high=0.5)
    dropout: float = param(0.3, "Up to this share of the points is dropped.", low=0.0, high=0.99)
    intensity: float = param(0.15, "Intensities are multiplied by 1 plus or minus up to this, and "
                             "raised or lowered by up to half of it; 0 stays 0.", low=0.0, high=1.0)
    height: float = param(0.1, "The sensor is raised or lowered by up to this.", unit="m", low=0.0,
                          high=2.0)
    tilt: float = param(0.01, "The ground is tilted ahead, and to the side, by up to this.",
                        unit="m/m", low=0.0, high=0.3)


@dataclass(frozen=True)
class DataParams(Params):
    """Which scenes."""

    scans: int = param(0, "Simulated scans in an epoch. 0: the budget decides.", low=0, high=10**7)
    street_scans: int = param(4, "Scans of each street, spread over a drive of 20 s.",
                              low=1, high=100)
    val_scans: int = param(0, "Simulated scans in a validation, of other streets. 0: the budget "
                           "decides.", low=0, high=10**6)
    people: float = param(3.0, "Pedestrians and cyclists on the streets trained on, as a multiple "
                          "of KITTI's.", low=0.0, high=100.0)
    val_people: float = param(1.0, "Likewise on the streets validated on.", low=0.0, high=100.0)
    cache: str = param("", "Folder that keeps simulated scans, and what is cut from scans, for "
                       "several runs. Empty: scans in --out.")
    cache_gb: float = param(20.0, "Scans are added to the cache until it has this size; the others "
                            "are simulated in every epoch.", unit="GB", low=0.0, high=1e6)
    val_share: float = param(PAPER_SHARE, "Share of the frames held out for validation, drawn by "
                             "the seed, of drives whole ones and the end of one, where neither "
                             "--val nor --val-split is given.", low=0.0, high=0.9)
    view: bool = param(True, "Use only the points in KITTI's image, since its labels end there.")
    min_points: int = param(5, "Objects and clusters with fewer points are left out of the "
                              "loss.", low=1, high=1000)


@dataclass(frozen=True)
class SceneTraining(LoopParams):
    """How long, where, and by which sensor."""

    scene: str = param("street", "Where the simulated scans are taken: street, campus or indoor, "
                       "or several in turn, such as street,campus.")
    sensor: str = param("hdl64e", "Sensor of the simulated scans: a sensor.yaml, the name of a "
                        "preset, or generic:BEAMS,LOWEST,HIGHEST,STEP,RATE.")
    mount_height: float = param(0.0, "Height of the sensor above the ground; beside simulated "
                                "scans not of a recording that says its own. 0: what its file or "
                                "preset says, and of a recording what it says or its first clouds "
                                "show.", unit="m", low=0.0, high=10.0)


@dataclass(frozen=True)
class PointPillarsTraining(SceneTraining):
    """All settings of train pointpillars."""

    version: str = param("v4", "EG-PointPillars version; v0 is PointPillars.",
                         choices=("v0", "v1", "v2", "v3", "v4"))
    size: str = param("compact", "full: the paper's network, for a GPU. compact: for two CPU "
                      "cores.", choices=("full", "compact"))
    range: str = param("ahead", "What the network sees: ahead, 69.12 m ahead and 39.68 m to each "
                       "side, as in KITTI; around, 51.2 m to every side.",
                       choices=("ahead", "around"))
    ahead: float = param(0.0, "Train only on what lies up to this far ahead, and behind, which is "
                         "quicker; the weights still cover the whole range. 0: the budget decides; "
                         "a large number: all of it.", unit="m", low=0.0, high=1000.0)
    aside: float = param(0.0, "Likewise to each side.", unit="m", low=0.0, high=1000.0)
    score: str = param("bev", "Score that chooses the best weights: bev, the mean AP from above at "
                       "the overlaps 0.5 / 0.25 / 0.25, or map, the mean AP in space at 0.7 / 0.5 "
                       "/ 0.5; both moderate, R40.", choices=("bev", "map"))
    augment: AugmentParams = AugmentParams()
    data: DataParams = DataParams()


@dataclass(frozen=True)
class ClusterAugmentParams(ThingParams):
    """Which clusters of a scene are trained on, and how they are changed; things are background
    clusters. 0 switches a change off."""

    objects: int = param(24, "Clusters of each class taken from a scene, at most.", low=1,
                         high=1000)
    background: int = param(40, "Background clusters taken from a scene, at most.", low=0,
                            high=10_000)
    sparse: float = param(0.0, "Share of the scenes that keep only 8 to 70 % of their points, "
                               "before they are cut, as from a sparser sensor.",
                          low=0.0, high=1.0)
    box_shift: float = param(0.15, "Objects are also cut out by their boxes, shifted by this; "
                                   "standard deviation.", unit="m", low=0.0, high=2.0)
    farther: float = param(1.5, "Some clusters are moved away, up to (1 + this) times their "
                                "range, and thinned accordingly.", low=0.0, high=10.0)
    dropout: float = param(0.9, "Half of the clusters lose up to this share of their points.",
                           low=0.0, high=0.99)
    scale: float = param(0.05, "Clusters are scaled by up to this share.", low=0.0, high=0.5)
    flip: float = param(0.5, "Probability that left and right are swapped.", low=0.0, high=1.0)
    intensity: float = param(0.2, "Intensities are multiplied by 1 plus or minus up to this.",
                             low=0.0, high=1.0)
    height: float = param(0.15, "The ground is assumed higher or lower by up to this, and for "
                                "each cluster by up to half of it in addition.",
                          unit="m", low=0.0, high=2.0)


@dataclass(frozen=True)
class PointNetTraining(SceneTraining):
    """All settings of train pointnet."""

    network: str = param("improved", "improved: that of the paper. pointnet, pointnet2: plain "
                         "PointNet and PointNet++ (single-scale grouping), to compare with. The "
                         "others are rows of the paper's ablation.", choices=(
                             "improved", "pointnet", "pointnet2", "base", "dynamic-threshold",
                             "log-point-count", "skip", "msg-mrg", "msg-skip", "mrg-skip"))
    proposer: str = param("", "Weights of PointPillars, or `package`, those that come with it: "
                          "what it proposes where nothing is, is learned as background, too, as "
                          "`fused` asks about its boxes. Empty: none.")
    augment: ClusterAugmentParams = ClusterAugmentParams()
    data: DataParams = DataParams()


@dataclass(frozen=True)
class AsTrained(Params):
    """Which simulated scans, unless what weights were trained on, see trained_for.as_trained."""

    scene: str = param("", "Where the simulated scans are taken: street, campus or indoor, or "
                       "several in turn, such as street,campus. Empty: where those were that the "
                       "weights were trained on.")
    sensor: str = param("", "Sensor of the simulated scans: a sensor.yaml, or the name of a "
                        "preset. Empty: the one that the weights were trained for.")


@dataclass(frozen=True)
class FusedTraining(AsTrained):
    """All settings of train fused."""

    scans: int = param(240, "Simulated scans that curves are fitted to, each of scenes of its own.",
                       low=2, high=100_000)
    people: float = param(2.5, "Pedestrians and cyclists in them, as a multiple of the usual "
                               "number.", low=0.0, high=100.0)
    mount_height: float = param(0.0, "Height of the sensor above the ground. 0: that of the scans "
                                "that the weights were trained on.", unit="m", low=0.0, high=10.0)
    range: str = seen_range()
