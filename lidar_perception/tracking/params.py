"""Parameters of the tracker, chosen on simulated drives; see docs/how-to/track.md."""

from __future__ import annotations

from dataclasses import dataclass

from lidar_perception.classes import TABLE
from lidar_perception.param_fields import Params, param

MOTION_MODELS = ("vehicle", "pedestrian", "cyclist")
MODEL_BY_CLASS_ID = tuple(MOTION_MODELS.index(row.motion_model) for row in TABLE)

NOMINAL_PERIOD_S = 0.1  # time between frames for which max_gate and max_absence are given


@dataclass(frozen=True)
class MotionParams(Params):
    """Parameters of a motion model: noise of the motion and of the measurements."""

    acceleration: float = param(2.0, "Noise density of random acceleration.", unit="m/s^1.5", low=0.01, high=100.0)
    turning: float = param(
        0.3,
        "Noise density of the turn rate; 0: constant velocity without a turn rate.",
        unit="rad/s^1.5",
        low=0.0,
        high=10.0,
    )
    wandering: float = param(0.1, "Noise density of the heading.", unit="rad/s^0.5", low=0.0, high=10.0)
    first_speed: float = param(8.0, "Standard deviation of the speed of a new track.", unit="m/s", low=0.01, high=100.0)
    slip: float = param(
        0.3, "Standard deviation of the speed perpendicular to the heading.", unit="m/s", low=0.01, high=100.0
    )
    position: float = param(0.25, "Standard deviation of a measured centre.", unit="m", low=0.001, high=10.0)
    heading: float = param(
        0.2,
        "Standard deviation of a measured heading, including the correlation of errors over time.",
        unit="rad",
        low=0.001,
        high=10.0,
    )
    reach: float = param(
        1.5,
        "Minimum gate radius: detections within this distance of the predicted centre always pass the gate.",
        unit="m",
        low=0.0,
        high=20.0,
    )


@dataclass(frozen=True)
class AssociationParams(Params):
    """Parameters of the assignment of detections to tracks."""

    overlap: float = param(
        0.5,
        "Weight of 1 - BEV IoU in the cost; the distance of the centres, divided by the gate radius, has the "
        "remaining weight. 0: distance only, 1: overlap only.",
        low=0.0,
        high=1.0,
    )
    sigmas: float = param(
        3.0,
        "Gate radius in standard deviations of the predicted centre, limited by `reach` and `max_gate`.",
        low=0.1,
        high=20.0,
    )
    max_gate: float = param(
        5.0,
        "Maximum gate radius 0.1 s after the previous frame; the maximum grows in proportion to the time.",
        unit="m",
        low=0.1,
        high=100.0,
    )
    strong: float = param(
        0.2,
        "Minimum score of detections that are matched first and can start tracks. Detections with lower scores only "
        "continue unmatched tracks.",
        low=0.0,
        high=1.0,
    )
    other_kind: float = param(
        0.8,
        "Cost added for matching a vehicle with a person (pairs with a cost above 1 are forbidden); half of it is "
        "added for matching a pedestrian with a cyclist.",
        low=0.0,
        high=10.0,
    )


@dataclass(frozen=True)
class ExistenceParams(Params):
    """Evidence, in log odds, that a track is a real object of its class and still present."""

    neutral: float = param(
        0.25,
        "Score that is evidence neither for nor against an object; scores are probabilities.",
        low=0.001,
        high=0.999,
    )
    gain: float = param(1.0, "Weight of a score's log odds.", low=0.0, high=10.0)
    correlation: float = param(
        0.8,
        "Correlation of the observations of an object: n observations count as n / (1 + (n - 1) correlation).",
        low=0.0,
        high=1.0,
    )
    memory: float = param(1.0, "Time constant of the decay of the evidence.", unit="s", low=0.05, high=1000.0)
    prior: float = param(0.0, "Log odds of a track before any evidence.", low=-10.0, high=10.0)
    missed: float = param(-1.5, "Evidence added for a frame without a detection of the track.", low=-10.0, high=0.0)
    moves: float = param(
        1.0, "Evidence added for motion; used only if the poses of the sensor are known.", low=0.0, high=10.0
    )
    walking: float = param(3.0, "Maximum speed of a pedestrian.", unit="m/s", low=0.5, high=100.0)
    faster: float = param(
        3.0,
        "Evidence against a pedestrian that is faster than `walking`, because cyclists can look like pedestrians; "
        "used only if the poses of the sensor are known.",
        low=0.0,
        high=20.0,
    )
    seen: float = param(2.0, "Increase of the log odds of presence per hit.", low=0.0, high=10.0)
    max_present: float = param(3.0, "Upper limit of the log odds of presence.", low=0.0, high=20.0)
    max_absence: float = param(
        0.4,
        "Maximum decrease of the log odds of presence per 0.1 s without a detection. It is low because occlusions "
        "last for a while.",
        low=0.01,
        high=10.0,
    )
    end: float = param(0.02, "A track ends when its probability of presence is below this.", low=0.0, high=0.5)


@dataclass(frozen=True)
class TrackingParams(Params):
    """Parameters of the tracker."""

    vehicle: MotionParams = MotionParams(first_speed=10.0, position=0.4)
    pedestrian: MotionParams = MotionParams(1.0, 0.0, 1.0, 1.0, 0.7, 0.15, 3.0, 0.7)
    cyclist: MotionParams = MotionParams(2.0, 0.3, 0.2, 4.0, 0.4, 0.2, 1.0, 1.2)
    association: AssociationParams = AssociationParams()
    existence: ExistenceParams = ExistenceParams()
    report: float = param(0.5, "Minimum probability at which a track is published.", low=0.0, high=1.0)
    report_unseen: float = param(
        0.5,
        "Minimum probability of presence at which a track is published in frames without a detection of it.",
        low=0.0,
        high=1.0,
    )
    overlap: float = param(
        0.3, "If the BEV IoU of two tracks is above this, the less probable one is removed.", low=0.0, high=1.0
    )
    moving_speed: float = param(0.5, "Minimum speed of a moving track.", unit="m/s", low=0.0, high=10.0)
    min_score: float = param(0.05, "Detections with a lower score are ignored.", low=0.0, high=1.0)
    max_detections: int = param(
        300, "Maximum number of detections per frame; those with the highest scores are used.", low=1, high=10_000
    )
    max_tracks: int = param(300, "Maximum number of tracks.", low=1, high=10_000)
    period: float = param(0.1, "Assumed period of frames without stamps.", unit="s", low=0.001, high=10.0)
    max_gap: float = param(
        1.0, "All tracks end when time jumps forward by more than this, or backward.", unit="s", low=0.01, high=100.0
    )
    max_ego_gap: float = param(
        1.0,
        "While poses are missing, the sensor is assumed to keep its velocity for this long, and then to stop.",
        unit="s",
        low=0.0,
        high=100.0,
    )

    def list_motion_params(self) -> tuple[MotionParams, ...]:
        """Return the motion parameters in the order of MOTION_MODELS."""
        return self.vehicle, self.pedestrian, self.cyclist


EGO_SOURCES = ("auto", "odometry", "tf", "kiss_icp", "none")  # choices for a node
RECORDED_EGO = ("auto", "recording", "kiss_icp", "none")  # choices for a recording


@dataclass(frozen=True)
class EgoParams(Params):
    """Parameters of the source of ego motion in a node."""

    source: str = param(
        "auto",
        "odometry: ~/input/odometry. tf: TF, from `input.fixed_frame`. kiss_icp: estimated from "
        "the scans on ~/input/points, with the extra [odometry]. none: tracks are relative to the "
        "sensor. auto: odometry as soon as a message has arrived; before that, TF if it connects "
        "the sensor with `input.fixed_frame`; after one second without either, kiss_icp if the "
        "extra is installed.",
        choices=EGO_SOURCES,
        fixed=True,
    )
    max_gap: float = param(
        0.5,
        "Maximum gap between poses that is interpolated, and maximum time of extrapolation after the last pose; after "
        "that, the tracker applies max_ego_gap.",
        unit="s",
        low=0.0,
        high=100.0,
    )
    max_wait: float = param(
        0.2, "Maximum time that a frame waits for a pose that arrives late.", unit="s", low=0.0, high=100.0
    )
