"""Parameters of training, from which the command line and its help are generated."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lidar_perception.detectors.params import make_range_param
from lidar_perception.param_fields import Params, flatten, param

CHANGEABLE = ("log_steps", "save_steps", "max_skipped", "data.cache", "data.cache_gb")  # may differ in a resumed run
PAPER_VAL_FRACTION = 751 / 7518  # fraction of the frames that paper B holds out


@dataclass(frozen=True)
class LoopParams(Params):
    """Length of the training, optimizer, and intervals between validations, checkpoints and logs."""

    steps: int = param(0, "Training steps. 0: determined by the epochs or the budget.", low=0, high=10**9)
    epochs: float = param(0.0, "Passes over the data, if steps is 0. 0: determined by the budget.", low=0.0, high=1e5)
    batch: int = param(4, "Scenes per step on each device.", low=1, high=4096)
    lr: float = param(0.003, "Maximum learning rate.", low=1e-9, high=10.0)
    warm_share: float = param(
        0.4, "Fraction of the steps in which the learning rate rises; after them it falls.", low=0.01, high=0.99
    )
    weight_decay: float = param(0.01, "Weight decay of AdamW.", low=0.0, high=1.0)
    clip: float = param(10.0, "Maximum norm of the gradient; larger ones are clipped. 0: no limit.", low=0.0, high=1e6)
    ema: float = param(
        0.999,
        "Decay of the moving average of the weights. The average is validated and saved. 0: no average.",
        low=0.0,
        high=0.999999,
    )
    amp: str = param(
        "auto",
        "Number format of the forward pass. auto: bf16 if the device has "
        "instructions for it (twice as fast on the CPU); otherwise fp16 "
        "on CUDA and float32 on the CPU.",
        choices=("auto", "bf16", "fp16", "off"),
    )
    validate_epochs: float = param(
        0.0, "Epochs between validations, if validate_steps is 0. 0: determined by the budget.", low=0.0, high=1e5
    )
    validate_steps: int = param(0, "Steps between validations. 0: determined by validate_epochs.", low=0, high=10**9)
    save_steps: int = param(200, "Steps between checkpoints for resuming.", low=1, high=10**9)
    log_steps: int = param(10, "Steps between logged losses.", low=1, high=10**6)
    max_skipped: int = param(
        50, "Give up after this many consecutive steps whose loss or gradient is not finite.", low=1, high=10**6
    )
    seed: int = param(0, "Seed of the weights, the order of the scenes and their augmentation.", low=0, high=2**31 - 1)

    def get_fixed_settings(self) -> dict[str, Any]:
        """Return the parameters by dotted name that must not change when a run is resumed."""
        return {name: value for name, value in flatten(self).items() if name not in CHANGEABLE}

    def compute_total_steps(self, steps_per_epoch: int) -> int:
        """Return the number of steps, or 0 if the budget determines it."""
        return self.steps or (max(1, round(self.epochs * steps_per_epoch)) if self.epochs else 0)

    def compute_validation_steps(self, steps_per_epoch: int) -> int:
        """Return the steps between validations, or 0 if the budget determines them."""
        return self.validate_steps or (
            max(1, round(self.validate_epochs * steps_per_epoch)) if self.validate_epochs else 0
        )


@dataclass(frozen=True)
class NoiseParams(Params):
    """Noise added to the ranges of the points."""

    beam_noise: float = param(
        0.08,
        "Maximum standard deviation of the range error shared by all points of a beam.",
        unit="m",
        low=0.0,
        high=1.0,
    )
    range_noise: float = param(
        0.08, "Maximum standard deviation of the range error of each point.", unit="m", low=0.0, high=1.0
    )


@dataclass(frozen=True)
class IntensityParams(Params):
    """Augmentation of the intensities of a scan, before they are normalized."""

    no_intensity: float = param(0.5, "Probability that a scene has no intensity.", low=0.0, high=1.0)
    fade: float = param(
        0.5,
        "Intensities are multiplied by a power of the range; the exponent is between minus and plus this value.",
        low=0.0,
        high=2.0,
    )
    quantize: int = param(
        16,
        "Minimum number of levels to which intensities are rounded; the number is drawn from this to 255. 0: off.",
        low=0,
        high=255,
    )
    speckle: float = param(0.05, "Maximum standard deviation of the error of each intensity.", low=0.0, high=1.0)


@dataclass(frozen=True)
class BackgroundParams(NoiseParams):
    """Augmentation of background that resembles objects."""

    things_stretch: float = param(
        0.5,
        "Pasted background is stretched or shrunk in width and height by factors of up to exp(this).",
        low=0.0,
        high=3.0,
    )
    things_intensity: float = param(
        0.8, "Intensities of pasted background are multiplied or divided by up to exp(this).", low=0.0, high=3.0
    )
    things_shine: float = param(
        0.25, "Probability that a part of pasted background is retroreflective, like a sign.", low=0.0, high=1.0
    )


@dataclass(frozen=True)
class AugmentParams(BackgroundParams, IntensityParams):
    """Augmentation of scenes. A value of 0 switches a change off."""

    crowded: float = param(
        0.7, "Probability that objects from other scenes are pasted into a scene.", low=0.0, high=1.0
    )
    cars: int = param(
        10, "Cars from other scenes are pasted until this many are in the network's range.", low=0, high=100
    )
    pedestrians: int = param(8, "Number of pedestrians in the network's range after pasting.", low=0, high=100)
    cyclists: int = param(8, "Number of cyclists in the network's range after pasting.", low=0, high=100)
    things: int = param(
        12, "Number of pasted background objects that resemble a standing person, such as posts.", low=0, high=100
    )
    database_scans: int = param(500, "Pasted objects come from at most this many scenes.", low=0, high=10**6)
    object_turn: float = param(0.157, "Maximum rotation of each object.", unit="rad", low=0.0, high=3.1416)
    object_shift: float = param(
        0.25, "Standard deviation of the shift of each object along x and y.", unit="m", low=0.0, high=5.0
    )
    flip: float = param(0.5, "Probability that left and right are swapped.", low=0.0, high=1.0)
    turn: float = param(
        0.785,
        "Maximum rotation of the scene about the sensor. A scene that is "
        "labelled all around is rotated by any angle, unless this is 0.",
        unit="rad",
        low=0.0,
        high=3.1416,
    )
    scale: float = param(0.05, "Maximum relative change of the scale of the scene.", low=0.0, high=0.5)
    dropout: float = param(0.3, "Maximum fraction of dropped points.", low=0.0, high=0.99)
    intensity: float = param(
        0.15,
        "Maximum relative change of the intensity; the maximum offset is half of it. An intensity of 0 stays 0.",
        low=0.0,
        high=1.0,
    )
    height: float = param(0.1, "Maximum change of the height of the sensor.", unit="m", low=0.0, high=2.0)
    tilt: float = param(0.01, "Maximum tilt of the ground, forwards and sideways.", unit="m/m", low=0.0, high=0.3)


@dataclass(frozen=True)
class DataParams(Params):
    """Scenes to train on."""

    scans: int = param(0, "Simulated scans per epoch. 0: determined by the budget.", low=0, high=10**7)
    street_scans: int = param(4, "Scans of each street, spread over a drive of 20 s.", low=1, high=100)
    val_scans: int = param(
        0, "Simulated scans of other streets per validation. 0: determined by the budget.", low=0, high=10**6
    )
    people: float = param(
        3.0, "Pedestrians and cyclists on the training streets, as a multiple of KITTI's.", low=0.0, high=100.0
    )
    val_people: float = param(
        1.0, "Pedestrians and cyclists on the validation streets, as a multiple of KITTI's.", low=0.0, high=100.0
    )
    cache: str = param(
        "", "Folder of simulated scans, and of objects cut from scans, shared by several runs. Empty: in --out."
    )
    cache_gb: float = param(
        20.0,
        "Maximum size of the cache. Scans that do not fit into it are simulated again in every epoch.",
        unit="GB",
        low=0.0,
        high=1e6,
    )
    val_share: float = param(
        PAPER_VAL_FRACTION,
        "Fraction of the frames held out for validation if "
        "neither --val nor --val-split is given. The seed selects them. From "
        "recorded drives, whole drives are held out, and the last part of one.",
        low=0.0,
        high=0.9,
    )
    view: bool = param(True, "Use only the points in KITTI's image, since its labels end there.")
    min_points: int = param(5, "Objects and clusters with fewer points are left out of the loss.", low=1, high=1000)


@dataclass(frozen=True)
class SceneTraining(LoopParams):
    """Parameters of training on recorded or simulated scenes."""

    scene: str = param(
        "street",
        "Environment of the simulated scans: street, campus or indoor, or several in turn, such as street,campus.",
    )
    sensor: str = param(
        "hdl64e",
        "Sensor of the simulated scans: a sensor.yaml, the name of a "
        "preset, or generic:BEAMS,LOWEST,HIGHEST,STEP,RATE.",
    )
    mount_height: float = param(
        0.0,
        "Height of the sensor above the ground. Recordings that "
        "give a height keep it. 0: from the sensor's file or preset; for "
        "a recording, from the recording or its first clouds.",
        unit="m",
        low=0.0,
        high=10.0,
    )


@dataclass(frozen=True)
class PointPillarsTraining(SceneTraining):
    """Parameters of train pointpillars."""

    version: str = param("v4", "EG-PointPillars version; v0 is PointPillars.", choices=("v0", "v1", "v2", "v3", "v4"))
    size: str = param(
        "compact", "full: the paper's network, for a GPU. compact: for two CPU cores.", choices=("full", "compact")
    )
    range: str = param(
        "ahead",
        "Detection range. ahead: 69.12 m ahead and 39.68 m to each side, "
        "as in KITTI; around: 51.2 m in all directions.",
        choices=("ahead", "around"),
    )
    ahead: float = param(
        0.0,
        "Train only up to this far ahead and behind, which is faster; the "
        "weights still cover the full range. 0: determined by the budget; a "
        "large number: the full range.",
        unit="m",
        low=0.0,
        high=1000.0,
    )
    aside: float = param(
        0.0,
        "Maximum lateral distance for training; 0 and large numbers as for `ahead`.",
        unit="m",
        low=0.0,
        high=1000.0,
    )
    score: str = param(
        "bev",
        "Score that selects the best weights. bev: mean BEV AP at the "
        "overlaps 0.5 / 0.25 / 0.25; map: mean 3D AP at 0.7 / 0.5 / 0.5. Both "
        "moderate, R40.",
        choices=("bev", "map"),
    )
    augment: AugmentParams = AugmentParams()
    data: DataParams = DataParams()


@dataclass(frozen=True)
class ClusterAugmentParams(BackgroundParams, IntensityParams):
    """Number of clusters to train on, and their augmentation. A value of 0 switches a change off."""

    objects: int = param(24, "Maximum number of clusters of each class per scene.", low=1, high=1000)
    background: int = param(40, "Maximum number of background clusters per scene.", low=0, high=10_000)
    sparse: float = param(
        0.0,
        "Fraction of the scenes that are reduced to 8 to 70 % of their points before clusters are cut, like scans of "
        "a sparser sensor.",
        low=0.0,
        high=1.0,
    )
    box_shift: float = param(
        0.15,
        "Objects are also cut out by their boxes, shifted with this standard deviation.",
        unit="m",
        low=0.0,
        high=2.0,
    )
    farther: float = param(
        1.5,
        "Some clusters are moved away, up to (1 + this) times their range, and lose points accordingly.",
        low=0.0,
        high=10.0,
    )
    dropout: float = param(0.9, "Half of the clusters lose up to this fraction of their points.", low=0.0, high=0.99)
    scale: float = param(0.05, "Maximum relative change of the scale of a cluster.", low=0.0, high=0.5)
    flip: float = param(0.5, "Probability that left and right are swapped.", low=0.0, high=1.0)
    intensity: float = param(0.2, "Maximum relative change of the gain of the intensity.", low=0.0, high=1.0)
    height: float = param(
        0.15,
        "Maximum error of the assumed ground height, plus up to half of it for each cluster.",
        unit="m",
        low=0.0,
        high=2.0,
    )


@dataclass(frozen=True)
class PointNetTraining(SceneTraining):
    """Parameters of train pointnet."""

    network: str = param(
        "improved",
        "improved: the paper's network. pointnet, pointnet2: plain "
        "PointNet and PointNet++ (single-scale grouping), for comparison. The "
        "others are for ablations: rows of the paper's table, other methods to "
        "select centroids and to weight points, and other radii.",
        choices=(
            "improved",
            "pointnet",
            "pointnet2",
            "base",
            "dynamic-threshold",
            "log-point-count",
            "skip",
            "msg-mrg",
            "msg-skip",
            "mrg-skip",
            "farthest",
            "ball-density",
            "farthest-ball-density",
            "radii-halved",
            "radii-doubled",
            "radii-quadrupled",
        ),
    )
    proposer: str = param(
        "",
        "Weights of PointPillars, or `package` for the shipped ones. Its "
        "wrong proposals are added as background examples, because `fused` "
        "classifies its boxes. Empty: none.",
    )
    augment: ClusterAugmentParams = ClusterAugmentParams()
    data: DataParams = DataParams()


@dataclass(frozen=True)
class FusedTraining(Params):
    """Parameters of train fused."""

    scene: str = param(
        "",
        "Environment of the simulated scans: street, campus or indoor, or several in turn, such as "
        "street,campus. Empty: the one that the weights were trained on.",
    )
    sensor: str = param(
        "",
        "Sensor of the simulated scans: a sensor.yaml, or the name of a "
        "preset. Empty: the sensor that the weights were trained for.",
    )
    scans: int = param(
        240, "Number of simulated scans to fit the curves to, each of a different scene.", low=2, high=100_000
    )
    people: float = param(
        2.5,
        "Number of pedestrians and cyclists in the simulated scans, as a multiple of the usual number.",
        low=0.0,
        high=100.0,
    )
    mount_height: float = param(
        0.0,
        "Height of the sensor above the ground. 0: the height that the weights were trained for.",
        unit="m",
        low=0.0,
        high=10.0,
    )
    range: str = make_range_param()
