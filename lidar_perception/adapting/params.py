"""Parameters of adapting: flags and docs are made from these fields."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.param_fields import param
from lidar_perception.training.params import AsTrained

# In the folder of a run: what was asked for, and how it went; and for people, under this title.
RECORD, REPORT, TITLE = "adapt.json", "report.html", "A detector, adapted"
BEST, HEARD, JUDGED = "best.safetensors", "heard.json", "judged.json"
POSES, SCANS, ROUND, LABELS = "poses", "scans", "round{}", "labels"
MADE = (RECORD, REPORT, BEST, HEARD, JUDGED, POSES, SCANS, ROUND.format("*"), LABELS)


@dataclass(frozen=True)
class AdaptParams(AsTrained):
    """How often, how fast, and with what."""

    rounds: int = param(2, "Rounds of looking and learning; each begins with the weights of the "
                        "one before.", low=1, high=10)
    steps: int = param(0, "Steps of the optimizer in a round. 0: the budget decides.", low=0,
                       high=10**7)
    lr: float = param(0.0005, "Highest learning rate.", low=1e-9, high=1.0)
    batch: int = param(4, "Scenes in a step.", low=1, high=1024)
    seed: int = param(0, "Seed of the order of the scenes, their augmentation and the simulated "
                      "streets.", low=0, high=2**31 - 1)
    frames: int = param(0, "Frames that are looked at, in pieces of consecutive ones. 0: the "
                        "budget decides.", low=0, high=10**6)
    scans: int = param(0, "Simulated scans that are mixed in, which also give objects to be pasted "
                       "into real ones. 0: as many as there are frames.", low=0, high=10**6)
    val_scans: int = param(24, "Simulated scans by which a round is judged.", low=1, high=10**5)
    mount_height: float = param(0.0, "Height of the sensor above the ground. 0: as the "
                                "recording says, or else as its first clouds show.", unit="m",
                                low=0.0, high=10.0)
    worse_simulated: float = param(2.0, "A round is discarded if the AP on simulated scans falls "
                                   "by more than this.", low=0.0, high=100.0)
    worse_agreement: float = param(0.02, "A round is discarded if the agreement falls by "
                                   "more than this.", low=0.0, high=1.0)
