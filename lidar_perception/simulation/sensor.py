"""What a spinning LiDAR is, as numbers: where its rays go and when, and presets of known models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from lidar_perception.types import SENSOR_HEIGHT, InputError

MAX_RAYS = 5_000_000  # in a turn; the densest sensors have 0.5 million. Each takes some 100 bytes


@dataclass(frozen=True)
class Sensor:
    """A LiDAR that turns about its z axis; angles in radians, lengths in metres.

    InputError for what cannot be: no beams, a height that is not positive, max_range <= min_range,
    more than MAX_RAYS rays in a turn.
    """

    elevations: tuple[float, ...]  # one per beam, descending; ring 0 is the highest
    azimuth_step: float            # between firings; rounded to a whole number in a turn
    height: float = SENSOR_HEIGHT  # above the road
    min_range: float = 0.9
    max_range: float = 120.0
    range_noise: float = 0.02      # standard deviation
    rate: float = 10.0             # turns per second
    reach: float = 50.0            # half of the returns of a surface of brightness 0.1 are lost
    silent: float = 0.0            # share of returns whose intensity is 0
    floor: float = 0.0             # an intensity below this is 0, too
    dropout: float = 0.005         # share of the returns lost for no reason
    divergence: float = 2e-3       # full angle of a beam
    pulse: float = 0.75            # two surfaces closer than this give one return between them
    lifts: tuple[float, ...] = ()  # where each beam starts on the z axis; empty: all at 0
    offsets: tuple[float, ...] = ()  # what each beam adds to the range; empty: nothing
    biases: tuple[float, ...] = ()  # what each beam adds to the intensity; empty: nothing
    fade: tuple[float, float] = (0.0, 0.0)  # from this range on intensity falls so much a metre
    blocked: tuple[tuple[float, float, float], ...] = ()  # by the vehicle: (first ring, from, to),
    #                                that ring and all lower ones, counter-clockwise, in degrees

    def __post_init__(self) -> None:
        up = np.asarray(self.elevations, np.float64)
        for wrong, what in (
                (not len(up), "elevations must name one beam at least"),
                (not (np.abs(up) < np.pi / 2).all() or not (np.diff(up) < 0).all(),
                 "elevations must descend, within 90 degrees of level"),
                *((len(each) not in (0, len(up)) or not np.isfinite(each).all(),
                   f"{name} must be empty or finite, one for each beam")
                  for name, each in (("lifts", self.lifts), ("offsets", self.offsets),
                                     ("biases", self.biases))),
                (not np.isfinite([*self.fade, *np.ravel(self.blocked)]).all(),
                 "fade and blocked must be finite"),
                (not 0 < self.azimuth_step <= np.pi / 2, "azimuth_step must be in 0 .. pi / 2"),
                (len(up) * 2 * np.pi > MAX_RAYS * self.azimuth_step,
                 f"a turn must have at most {MAX_RAYS} rays; give a larger step or fewer beams"),
                (not 0 < self.height < np.inf, "height must be positive"),
                (not 0 <= self.min_range < self.max_range < np.inf,
                 "max_range must exceed min_range, which must not be negative"),
                (not 0 < self.rate < np.inf, "rate must be positive"),
                (not 0 < self.reach <= np.inf, "reach must be positive"),
                (not all(0 <= x <= 1 for x in (self.dropout, self.silent, self.floor)),
                 "dropout, silent and floor must be in 0 .. 1"),
                (not all(0 <= x < np.inf for x in (self.range_noise, self.divergence, self.pulse)),
                 "range_noise, divergence and pulse must not be negative")):
            if wrong:
                raise InputError(f"impossible sensor: {what}")

    @property
    def columns(self) -> int:
        """Firings in a turn."""
        return round(2 * np.pi / self.azimuth_step)

    @property
    def rings(self) -> int:
        """Beams."""
        return len(self.elevations)

    def directions(self) -> np.ndarray:
        """(columns, rings, 3) float64 unit vectors, counter-clockwise from straight ahead."""
        azimuth = np.arange(self.columns)[:, None] * (2 * np.pi / self.columns)
        elevation = np.asarray(self.elevations)
        flat = np.cos(elevation)
        return np.stack(np.broadcast_arrays(
            np.cos(azimuth) * flat, np.sin(azimuth) * flat, np.sin(elevation)), axis=-1)

    def origins(self) -> np.ndarray:
        """(rings, 3) float64 m: where the beams start, in the sensor's frame."""
        return np.column_stack([np.zeros((self.rings, 2)), self.lifts or np.zeros(self.rings)])

    def times(self) -> np.ndarray:
        """(columns,) float64 seconds since the turn began, 0 <= time < 1 / rate. As on KITTI's car
        the sensor turns clockwise from the rear, and so looks ahead in the middle of the turn."""
        columns = self.columns
        return (columns // 2 - np.arange(columns)) % columns / (columns * self.rate)

    def open_rays(self) -> np.ndarray:
        """(columns, rings) bool: not blocked by the vehicle."""
        azimuth, ring = np.arange(self.columns) * (360 / self.columns), np.arange(self.rings)
        free = np.ones((self.columns, self.rings), bool)
        for first, start, end in self.blocked:
            within = (azimuth - start) % 360 < (end - start) % 360
            free &= ~(within[:, None] & (ring >= first))
        return free


class Motion(NamedTuple):
    """How the sensor moves while it turns: velocity (3,) m/s in the sensor's frame at the stamp,
    yaw_rate rad/s, counter-clockwise. stamp: the share of the turn that is over at the stamp,
    0 start, 1 end. In the middle, as in KITTI, boxes at the stamp fit what is straight ahead."""

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rate: float = 0.0
    stamp: float = 0.5


STILL = Motion()


class Rays(NamedTuple):
    """All rays of a turn, in the sensor's frame at the stamp (float64): origin and direction
    (columns, rings, 3), metres and unit vectors; since (columns,) seconds after the stamp."""

    origin: np.ndarray
    direction: np.ndarray
    since: np.ndarray


def rays(sensor: Sensor, motion: Motion = STILL) -> Rays:
    """Where the rays start and go while the sensor moves."""
    since = sensor.times() - motion.stamp / sensor.rate
    moved = since[:, None] * np.asarray(motion.velocity, np.float64)
    direction = sensor.directions()
    if motion.yaw_rate:  # beams start on the z axis, so that only their directions turn
        turned = motion.yaw_rate * since[:, None]
        cos, sin = np.cos(turned), np.sin(turned)
        x, y, z = np.moveaxis(direction, -1, 0)
        direction = np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)
    return Rays(moved[:, None] + sensor.origins(), direction, since)


def generic(beams: int, lowest: float, highest: float, azimuth_step: float, rate: float,
            **fields: float) -> Sensor:
    """A sensor of evenly spaced beams; angles in degrees, rate in turns per second, and any other
    field of Sensor by name. InputError for impossible values."""
    if beams > MAX_RAYS:  # before there is a list of them
        raise InputError(f"impossible sensor: {beams} beams must be {MAX_RAYS} at most")
    if beams > 1 and not lowest < highest:
        raise InputError(f"impossible sensor: lowest {lowest} must be below highest {highest}")
    return Sensor(tuple(np.radians(np.linspace(highest, lowest, max(beams, 0))).tolist()),
                  float(np.radians(azimuth_step)), rate=rate, **fields)


# KITTI's HDL-64E S2. Found from 57 of KITTI's full scans, all of one car: in a file the beams stand
# one after the other, each from azimuth 0 to 360 degrees; to the points of each a line z = lift +
# distance * tan(elevation) was fitted (least squares, outliers dropped). The elevations of single
# scans differ by less than 0.005 degrees (interquartile range); the lifts fall evenly within the
# upper and the lower block of 32 lasers. The fullest beams have 2136 points in a turn (median).
_HDL64E_DEGREES = (
    1.94, 1.57, 1.30, 0.87, 0.58, 0.18, -0.09, -0.45, -0.80, -1.20, -1.49, -1.83, -2.21, -2.55,
    -2.87, -3.24, -3.54, -3.94, -4.22, -4.59, -4.91, -5.25, -5.61, -5.96, -6.33, -6.68, -7.00,
    -7.29, -7.68, -8.06, -8.31, -8.71, -9.03, -9.57, -10.06, -10.47, -10.96, -11.60, -12.11,
    -12.56, -13.04, -13.48, -14.05, -14.60, -15.19, -15.66, -16.18, -16.55, -17.19, -17.73,
    -18.32, -18.80, -19.32, -19.74, -20.22, -20.79, -21.32, -21.94, -22.44, -22.86, -23.32,
    -23.97, -24.51, -25.00)
_HDL64E_LIFTS = (*np.linspace(0.209, 0.198, 32).tolist(), *np.linspace(0.126, 0.116, 32).tolist())

# From facades on 14 of KITTI's full scans: how far each beam's median is behind the plane through
# them all. The two halves of the scans agree (correlation 0.92); below beam 38 there are too few.
_HDL64E_OFFSETS = (
    0.0, -0.01, 0.02, -0.01, 0.0, -0.05, 0.04, -0.02, -0.02, 0.0, 0.03, 0.0, 0.02, 0.01, -0.02,
    -0.02, 0.02, -0.01, 0.04, 0.01, 0.0, -0.01, -0.02, -0.01, 0.02, 0.0, 0.02, -0.03, 0.03, 0.02,
    0.01, 0.01, -0.01, -0.02, -0.01, -0.03, -0.01, -0.03, 0.03, *[0.0] * 25)
# From 27 of KITTI's full scans: how the median intensity of each beam within 18 m differs from the
# median of them all.
_HDL64E_BIASES = (
    0.07, 0.03, 0.03, -0.09, 0.05, -0.02, 0.07, 0.0, 0.06, -0.04, 0.02, 0.05, 0.06, 0.02, -0.01,
    -0.01, 0.0, 0.01, 0.04, -0.03, 0.03, -0.09, 0.03, 0.05, -0.01, 0.01, 0.03, 0.02, 0.02, -0.05,
    0.02, 0.03, -0.01, -0.01, 0.0, -0.10, -0.19, 0.0, 0.05, 0.04, -0.03, 0.0, -0.12, 0.01, 0.0,
    0.0, 0.01, -0.03, -0.07, 0.02, 0.04, -0.24, -0.01, -0.10, -0.10, -0.01, 0.01, 0.05, -0.09,
    -0.10, -0.10, 0.02, 0.05, 0.03)
# Sectors without points in the lower rings of these scans: the roof of KITTI's car and its racks.
_HDL64E_BLOCKED = (
    (44, 160, 165), (44, 199, 204), (48, 285, 302), (52, 170, 192), (54, 160, 204), (56, 130, 136),
    (56, 231, 236), (58, 346, 15), (58, 155, 207), (62, 343, 20), (62, 150, 212), (62, 324, 330))
_HDL64E_COLUMNS = 2140  # in a turn of 0.1 s


def hdl64e(rate: float = 10.0) -> Sensor:
    """KITTI's HDL-64E S2 at so many turns per second, 5 to 20: the lasers fire at a fixed rate, so
    that a slower turn is a finer one. InputError for another rate.

    Divergence and reach are those of the data sheet: 50 m for pavement, which shines back a tenth.
    Within a beam the range jitters by 0.008 to 0.009 m on the road, sidewalks and facades of a
    SemanticKITTI scan (second differences). KITTI's points end at 80 m. Intensity falls by 0.008 a
    metre from 18 m on: so the quantiles over all 27 scans do up to 80 m, within 0.02. On 57 frames
    1 % of the points have 0.01 to 0.05, and half of those on cars have 0."""
    if not 5 <= rate <= 20:
        raise InputError(f"impossible sensor: rate {rate} must be 5 .. 20 turns per second")
    return Sensor(tuple(np.radians(_HDL64E_DEGREES).tolist()),
                  2 * np.pi / round(_HDL64E_COLUMNS * 10 / rate), rate=rate, max_range=80.0,
                  range_noise=0.01, lifts=_HDL64E_LIFTS, offsets=_HDL64E_OFFSETS,
                  biases=_HDL64E_BIASES, fade=(18.0, 0.008), silent=0.07, floor=0.08,
                  blocked=_HDL64E_BLOCKED)


HDL64E = hdl64e()

GENERIC = "generic:BEAMS,LOWEST,HIGHEST,STEP,RATE (degrees, turns a second)"

# Angles, ranges and divergences of the others are meant to be those of their data sheets; the
# HDL-32E is nuScenes', whose sweeps have 1084 firings.
SENSORS: dict[str, Sensor] = {
    "hdl64e": HDL64E,
    "hdl32e": generic(32, 10.67 - 31 * 4 / 3, 10.67, 360 / 1084, 20.0, height=1.84,
                      max_range=100.0, divergence=2.8e-3),
    "vlp16": generic(16, -15.0, 15.0, 0.2, 10.0, max_range=100.0, range_noise=0.03,
                     divergence=3e-3),
    "os1_64": generic(64, -16.6, 16.6, 360 / 1024, 10.0, range_noise=0.03, divergence=3.1e-3,
                      reach=45.0),
}


def sensor_named(name: str) -> Sensor:
    """The preset of that name, or a generic one as GENERIC says; InputError, which names them all,
    for anything else."""
    if name.startswith("generic:"):
        try:
            beams, *numbers = map(float, name.removeprefix("generic:").split(","))
            return generic(int(beams), *numbers)
        except (TypeError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(f"sensor {name!r} must be {GENERIC}, such as "
                             "generic:32,-25,15,0.2,10") from None
    if name not in SENSORS:
        raise InputError(f"unknown sensor {name!r}: must be one of {', '.join(SENSORS)}, or "
                         f"{GENERIC}")
    return SENSORS[name]
