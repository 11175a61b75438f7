"""Parameters of the tracker. Chosen on simulated drives, see docs/how-to/track.md."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.classes import TABLE
from lidar_perception.param_fields import Params, param

KINDS = ("vehicle", "pedestrian", "cyclist")  # that move, and are told apart, in the same way
KIND_OF_CLASS = tuple(KINDS.index(row.moves_as) for row in TABLE)

FRAME = 0.1  # s from frame to frame, for which max_gate and max_absence are


@dataclass(frozen=True)
class MotionParams(Params):
    """How one kind of object moves, and how well a detector measures it."""

    acceleration: float = param(2.0, "Noise density of random acceleration.",
                                unit="m/s^1.5", low=0.01, high=100.0)
    turning: float = param(0.3, "Density of the change of the turn rate; 0: no turn rate, the "
                           "velocity is constant.", unit="rad/s^1.5", low=0.0, high=10.0)
    wandering: float = param(0.1, "Density of a heading that changes by itself.",
                             unit="rad/s^0.5", low=0.0, high=10.0)
    first_speed: float = param(8.0, "Standard deviation of the speed of a new track.", unit="m/s",
                               low=0.01, high=100.0)
    slip: float = param(0.3, "Standard deviation of the speed across the heading.", unit="m/s",
                        low=0.01, high=100.0)
    position: float = param(0.25, "Standard deviation of a measured centre.", unit="m", low=0.001,
                            high=10.0)
    heading: float = param(0.2, "Standard deviation of a measured heading, as one look in many "
                           "whose errors are alike.", unit="rad", low=0.001, high=10.0)
    reach: float = param(1.5, "Centres so near to the predicted one can belong to a track, however "
                         "sure it is.", unit="m", low=0.0, high=20.0)


@dataclass(frozen=True)
class AssociationParams(Params):
    """Which detection belongs to which track."""

    overlap: float = param(0.5, "Weight of what does not overlap, seen from above, in the cost; "
                           "the rest is the centres' distance by the gate. 0: distance "
                           "alone, 1: overlap alone.", low=0.0, high=1.0)
    sigmas: float = param(3.0, "The gate: so many standard deviations of the predicted centre, but "
                          "not less than reach.", low=0.1, high=20.0)
    max_gate: float = param(5.0, "No gate is wider a tenth of a second after the frame before; "
                            "later in proportion.", unit="m", low=0.1, high=100.0)
    strong: float = param(0.2, "Detections from this score on look for tracks first, and can start "
                          "one. Weaker ones keep alive what is left.", low=0.0, high=1.0)
    other_kind: float = param(0.8, "Added to the cost, which allows 1, where vehicle and person "
                              "are to be one; half of it for pedestrian and cyclist.", low=0.0,
                              high=10.0)


@dataclass(frozen=True)
class ExistenceParams(Params):
    """Evidence, in log odds, that a track is what it claims to be, and that it is still there."""

    neutral: float = param(0.25, "The score that says nothing for or against an object, for scores "
                           "that are probabilities.", low=0.001, high=0.999)
    gain: float = param(1.0, "Weight of a score's log odds.", low=0.0, high=10.0)
    correlation: float = param(0.8, "Of the evidence of looks at one object: n of them count as "
                               "n / (1 + (n - 1) correlation).", low=0.0, high=1.0)
    memory: float = param(1.0, "Evidence fades with this time constant.", unit="s", low=0.05,
                          high=1000.0)
    prior: float = param(0.0, "Log odds of a track before any evidence.", low=-10.0, high=10.0)
    missed: float = param(-1.5, "Evidence of a look that found nothing.", low=-10.0, high=0.0)
    moves: float = param(1.0, "Evidence of motion, where poses say what stands: posts do not "
                         "walk.", low=0.0, high=10.0)
    walking: float = param(3.0, "Greatest walking speed of a pedestrian.", unit="m/s",
                           low=0.5, high=100.0)
    faster: float = param(3.0, "Evidence against being a pedestrian above that speed, where "
                          "poses say what stands: riders look like people.", low=0.0, high=20.0)
    seen: float = param(2.0, "What a hit adds to the log odds of being there still.", low=0.0,
                        high=10.0)
    max_present: float = param(3.0, "Upper limit of the log odds of being there still.",
                               low=0.0, high=20.0)
    max_absence: float = param(0.4, "Most that misses subtract from them in 0.1 s: what is "
                               "hidden stays hidden for a while.", low=0.01, high=10.0)
    end: float = param(0.02, "A track ends when it is there with a lower probability.", low=0.0,
                       high=0.5)


@dataclass(frozen=True)
class TrackingParams(Params):
    """Tracks from detections."""

    vehicle: MotionParams = MotionParams(first_speed=10.0, position=0.4)
    pedestrian: MotionParams = MotionParams(1.0, 0.0, 1.0, 1.0, 0.7, 0.15, 3.0, 0.7)
    cyclist: MotionParams = MotionParams(2.0, 0.3, 0.2, 4.0, 0.4, 0.2, 1.0, 1.2)
    association: AssociationParams = AssociationParams()
    existence: ExistenceParams = ExistenceParams()
    report: float = param(0.5, "Tracks that exist with at least this probability come out.",
                          low=0.0, high=1.0)
    report_unseen: float = param(0.5, "Tracks that were missed come out down to this probability "
                                 "of being there.", low=0.0, high=1.0)
    overlap: float = param(0.3, "Of two tracks that overlap by more than this, seen from above, "
                           "the less probable one ends.", low=0.0, high=1.0)
    moving_speed: float = param(0.5, "A track that is faster counts as moving.", unit="m/s",
                                low=0.0, high=10.0)
    min_score: float = param(0.05, "Detections of a lower score are left out.", low=0.0, high=1.0)
    max_detections: int = param(300, "The best this many detections of a frame take part.", low=1,
                                high=10_000)
    max_tracks: int = param(300, "Most tracks that are kept at a time.", low=1, high=10_000)
    period: float = param(0.1, "Time between two frames where there are no stamps.", unit="s",
                          low=0.001, high=10.0)
    max_gap: float = param(1.0, "Tracks end where time jumps ahead by more than this, or back.",
                           unit="s", low=0.01, high=100.0)
    max_ego_gap: float = param(1.0, "So long the sensor is taken to move on as before where poses "
                               "are missing; from then on it stands.", unit="s", low=0.0,
                               high=100.0)

    def kinds(self) -> tuple[MotionParams, ...]:
        """By KINDS."""
        return self.vehicle, self.pedestrian, self.cyclist


EGO_SOURCES = ("auto", "odometry", "tf", "kiss_icp", "none")  # of a node
RECORDED_EGO = ("auto", "recording", "kiss_icp", "none")      # of a recording


@dataclass(frozen=True)
class EgoParams(Params):
    """Where a node learns how the sensor moves."""

    source: str = param(
        "auto", "odometry: ~/input/odometry. tf: TF, from `input.fixed_frame`. kiss_icp: from the "
        "scans on ~/input/points, by the extra [odometry]. none: tracks are relative to the "
        "sensor. auto: the odometry as soon as some comes; where none has come yet, TF if it "
        "connects the sensor with `input.fixed_frame`; and after a second with neither, kiss_icp "
        "if the extra is installed.", choices=EGO_SOURCES, fixed=True)
    max_gap: float = param(0.5, "Between two poses, and after the last one, a pose is taken to be "
                           "known for so long; beyond, max_ego_gap of the tracker goes on.",
                           unit="s", low=0.0, high=100.0)
    max_wait: float = param(0.2, "A frame waits for its pose this long, where poses come but are a "
                            "little behind.", unit="s", low=0.0, high=100.0)
