"""Models of spinning LiDARs: ray directions and firing times, and sensor files."""

from __future__ import annotations

import reprlib
from dataclasses import dataclass, fields, replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml

from lidar_perception.runs.files import read_text, shorten_error
from lidar_perception.types import SENSOR_HEIGHT, InputError, suggest_name

_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the C loader is ten times faster, but optional
MAX_BYTES = 1 << 20  # maximum size of a sensor file
GOLDEN_RATIO = 0.6180339887498949
MAX_RATE = 1000.0  # maximum rate in revolutions per second
MAX_NOISE = 1.0  # maximum range noise in metres
MAX_BEAMS = 1 << 16  # the ring column is uint16
MAX_RAYS = 5_000_000  # rays per revolution, 100 bytes each; the densest sensors have 0.5 million


@dataclass(frozen=True)
class Sensor:
    """A LiDAR that spins about its z axis; angles in radians, lengths in metres.

    Raises:
        InputError: A value is invalid, such as no beams, a height that is not positive,
            max_range <= min_range, more than MAX_BEAMS beams, or more than MAX_RAYS rays per
            revolution.
    """

    elevations: tuple[float, ...]  # one per beam, descending; ring 0 is the highest
    azimuth_step: float  # angle between firings; rounded so that a revolution is a whole number of steps
    height: float = SENSOR_HEIGHT  # height above the road
    min_range: float = 0.9
    max_range: float = 120.0
    range_noise: float = 0.02  # standard deviation of the range
    rate: float = 10.0  # revolutions per second
    reach: float = 50.0  # range at which half of the returns from a surface of brightness 0.1 are lost
    silent: float = 0.0  # fraction of returns with intensity 0
    floor: float = 0.0  # lower intensities are reported as 0
    dropout: float = 0.005  # fraction of returns lost at random
    divergence: float = 2e-3  # full opening angle of a beam
    pulse: float = 0.75  # pulse length: two surfaces closer together than this give one return between them
    lifts: tuple[float, ...] = ()  # origin of each beam on the z axis; empty: all 0
    offsets: tuple[float, ...] = ()  # range offset of each beam; empty: all 0
    biases: tuple[float, ...] = ()  # intensity offset of each beam; empty: all 0
    fade: tuple[float, float] = (0.0, 0.0)  # (range beyond which the intensity falls, loss per metre)
    # Sectors blocked by the vehicle: (first ring, from, to) in degrees counter-clockwise, for this ring and
    # all lower ones. 0 to 360 covers all directions.
    blocked: tuple[tuple[float, float, float], ...] = ()
    wander: float = 0.0  # maximum downward shift of the beams, which differs between revolutions

    def __post_init__(self) -> None:
        elevations = np.asarray(self.elevations, np.float64)
        for is_invalid, message in (
            (not len(elevations), "elevations must contain at least one beam"),
            (len(elevations) > MAX_BEAMS, f"elevations must contain at most {MAX_BEAMS} beams"),
            (
                not (np.abs(elevations) < np.pi / 2).all() or not (np.diff(elevations) < 0).all(),
                "elevations must be in descending order, between -90 and 90 degrees",
            ),
            *(
                (
                    len(values) not in (0, len(elevations)) or not np.isfinite(values).all(),
                    f"{name} must be empty or contain one finite value per beam",
                )
                for name, values in (("lifts", self.lifts), ("offsets", self.offsets), ("biases", self.biases))
            ),
            (not np.isfinite([*self.fade, *np.ravel(self.blocked)]).all(), "fade and blocked must be finite"),
            (not 0 < self.azimuth_step <= np.pi / 2, "azimuth_step must be above 0 and at most 90 degrees"),
            (
                len(elevations) * 2 * np.pi > MAX_RAYS * self.azimuth_step,
                f"a revolution must have at most {MAX_RAYS} rays; use a larger azimuth_step or fewer beams",
            ),
            (not 0 < self.height < np.inf, "height must be positive"),
            (not 0 <= self.min_range < self.max_range < np.inf, "expected 0 <= min_range < max_range, both finite"),
            (not 0 < self.rate <= MAX_RATE, f"rate must be above 0 and at most {MAX_RATE:g}"),
            (not 0 < self.reach <= np.inf, "reach must be positive"),
            (
                not all(0 <= x <= 1 for x in (self.dropout, self.silent, self.floor)),
                "dropout, silent and floor must be between 0 and 1",
            ),
            (self.dropout == 1, "dropout must be below 1"),
            (self.divergence > np.pi / 2, "divergence must be at most 90 degrees"),
            (
                not all(0 <= row[0] < max(1, len(elevations)) for row in self.blocked),
                f"each entry of blocked must begin with a ring index from 0 to {max(0, len(elevations) - 1)}",
            ),
            (
                not all(0 <= x < np.inf for x in (self.range_noise, self.divergence, self.pulse)),
                "range_noise, divergence and pulse must not be negative",
            ),
            (self.range_noise > MAX_NOISE, f"range_noise must be at most {MAX_NOISE:g} m"),
            (
                len(elevations) and not (0 <= self.wander < np.pi / 2 + elevations.min()),
                "wander must not be negative or tilt a beam beyond straight down",
            ),
        ):
            if is_invalid:
                raise InputError(f"invalid sensor: {message}")

    @property
    def columns(self) -> int:
        """Number of firings per revolution."""
        return round(2 * np.pi / self.azimuth_step)

    @property
    def rings(self) -> int:
        """Number of beams."""
        return len(self.elevations)

    def shift_beams(self, revolution: int) -> Sensor:
        """Return the sensor with its beams shifted as in this revolution. Unchanged if `wander` is 0.

        All beams are lowered by the same fraction of `wander`. The golden ratio distributes these
        fractions evenly over the revolutions.
        """
        if not self.wander:
            return self
        shift = self.wander * (revolution * GOLDEN_RATIO % 1.0)
        return replace(self, elevations=tuple(elevation - shift for elevation in self.elevations))

    def compute_directions(self) -> np.ndarray:
        """Return the unit vectors (columns, rings, 3) float64 of all rays, counter-clockwise from x."""
        return _compute_directions(self.elevations, self.columns).copy()

    def compute_origins(self) -> np.ndarray:
        """Return the origins of the beams in the sensor's frame, (rings, 3) float64 m."""
        return np.column_stack([np.zeros((self.rings, 2)), self.lifts or np.zeros(self.rings)])

    def compute_firing_times(self) -> np.ndarray:
        """Return the time of each firing since the start of the revolution, (columns,) float64 s.

        The sensor spins clockwise and starts at the rear, as on KITTI's car. It points forward in
        the middle of the revolution.
        """
        columns = self.columns
        return (columns // 2 - np.arange(columns)) % columns / (columns * self.rate)

    def find_unblocked_rays(self) -> np.ndarray:
        """Return (columns, rings) bool, False for rays that the vehicle blocks."""
        azimuth, ring = np.arange(self.columns) * (360 / self.columns), np.arange(self.rings)
        is_unblocked = np.ones((self.columns, self.rings), bool)
        for first_ring, start, end in self.blocked:
            width = (end - start) % 360 if abs(end - start) < 360 else 360
            in_sector = (azimuth - start) % 360 < width
            is_unblocked &= ~(in_sector[:, None] & (ring >= first_ring))
        return is_unblocked


@lru_cache(maxsize=2)
def _compute_directions(elevations: tuple[float, ...], columns: int) -> np.ndarray:
    azimuth = np.arange(columns)[:, None] * (2 * np.pi / columns)
    elevation = np.asarray(elevations)
    x, y = np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation)
    return np.stack(np.broadcast_arrays(x, y, np.sin(elevation)), axis=-1)


class Motion(NamedTuple):
    """Motion of the sensor during a revolution.

    Attributes:
        velocity: (3,) m/s in the sensor's frame at the stamp.
        yaw_rate: rad/s, counter-clockwise.
        stamp: Time of the cloud's stamp as a fraction of the revolution. At 0.5, as in KITTI, the
            sensor points forward.
    """

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_rate: float = 0.0
    stamp: float = 0.5


NO_MOTION = Motion()


class Rays(NamedTuple):
    """All rays of a revolution in the sensor's frame at the stamp, float64.

    Attributes:
        origin: (columns, rings, 3) m.
        direction: (columns, rings, 3) unit vectors.
        times: (columns,) time of each firing relative to the stamp, s.
    """

    origin: np.ndarray
    direction: np.ndarray
    times: np.ndarray


def make_rays(sensor: Sensor, motion: Motion = NO_MOTION) -> Rays:
    """Compute the rays of a revolution of a moving sensor."""
    times = sensor.compute_firing_times() - motion.stamp / sensor.rate
    displacement = times[:, None] * np.asarray(motion.velocity, np.float64)
    direction = sensor.compute_directions()
    if motion.yaw_rate:  # the origins of the beams are on the z axis, so only the directions rotate
        yaw = motion.yaw_rate * times[:, None]
        cos, sin = np.cos(yaw), np.sin(yaw)
        x, y = direction[..., 0].copy(), direction[..., 1].copy()
        direction[..., 0] = cos * x - sin * y
        direction[..., 1] = sin * x + cos * y
    return Rays(displacement[:, None] + sensor.compute_origins(), direction, times)


def make_generic_sensor(
    beams: int, lowest: float, highest: float, azimuth_step: float, rate: float, **fields: Any
) -> Sensor:
    """Make a sensor with evenly spaced beams.

    Args:
        beams: Number of beams.
        lowest, highest: Elevations of the lowest and the highest beam, degrees.
        azimuth_step: Angle between two firings, degrees.
        rate: Revolutions per second.
        fields: Other fields of Sensor.

    Raises:
        InputError: A value is invalid.
    """
    if beams > MAX_BEAMS:  # checked before the elevations are allocated
        raise InputError(f"invalid sensor: beams = {beams} must be at most {MAX_BEAMS}")
    if beams > 1 and not lowest < highest:
        raise InputError(f"invalid sensor: lowest {lowest} must be below highest {highest}")
    return Sensor(
        tuple(np.radians(np.linspace(highest, lowest, max(beams, 0))).tolist()),
        float(np.radians(azimuth_step)),
        rate=rate,
        **fields,
    )


def load_sensor(path: str | Path) -> Sensor:
    """Load a sensor from a YAML file.

    The file contains the fields of Sensor, with all angles in degrees, and optionally `name`.
    `elevations`, `azimuth_step` and `rate` are required. See sensors/*.yaml for examples. The
    command `setup` writes such a file.

    Raises:
        InputError: The file is not a sensor file, or a value is invalid.
    """
    remedy = "see config/sensors/ for examples, or measure one with 'lidar-perception setup'"
    text = read_text(path, MAX_BYTES)
    try:
        content = yaml.load(text, _Loader)
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path} is not valid YAML: {shorten_error(error)}") from None
    if not isinstance(content, dict):
        raise InputError(f"{path} does not describe a sensor; {remedy}")
    values = {key: value for key, value in content.items() if key != "name"}
    field_names = {field.name for field in fields(Sensor)}
    for key in values:
        if key not in field_names:
            raise InputError(f"{path}: unknown field {key!r}; choose from name, {', '.join(sorted(field_names))}")
    for key in ("elevations", "azimuth_step", "rate"):
        if key not in values:
            raise InputError(f"{path}: {key} is missing; {remedy}")
    try:
        return Sensor(**{key: _convert_field(key, value) for key, value in values.items()})
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


# Shape of each field that is a list; 0 for any length.
FIELD_SHAPES = {"elevations": (0,), "lifts": (0,), "offsets": (0,), "biases": (0,), "fade": (2,), "blocked": (0, 3)}
DEGREE_FIELDS = ("elevations", "azimuth_step", "divergence", "wander")


def _convert_field(key: str, value: Any) -> Any:
    """Convert a value of a sensor file to the type and unit of its field. Raise InputError if that is impossible."""
    shape = FIELD_SHAPES.get(key, ())
    if value == [] and shape[:1] == (0,):
        return ()
    try:
        numbers = np.array(None if isinstance(value, (bool, str)) else value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full((0,) * 9, np.nan)
    if (
        numbers.ndim != len(shape)
        or any(n not in (0, m) for n, m in zip(shape, numbers.shape))
        or (np.isnan(numbers).any())
        or (len(shape) == 2 and (~np.isfinite(numbers[:, 0]) | (numbers[:, 0] != np.floor(numbers[:, 0]))).any())
    ):
        length = f"{shape[0]} " if any(shape) else ""
        form = ("a number", f"a list of {length}numbers", "a list of [ring, from, to]")[len(shape)]
        raise InputError(f"{key} = {reprlib.repr(value)[:60]} must be {form}")
    rows = (np.radians(numbers) if key in DEGREE_FIELDS else numbers).tolist()
    if not shape:
        return rows
    return tuple((int(row[0]), *row[1:]) for row in rows) if len(shape) == 2 else tuple(rows)


def _normalize_name(name: str) -> str:
    """Convert a sensor name to lower case and remove punctuation."""
    return "".join(c for c in name.lower() if c.isalnum())


# Sensor file of each preset, by normalized name.
PRESET_FILES = {_normalize_name(path.stem): path for path in sorted((Path(__file__).parent / "sensors").glob("*.yaml"))}


@cache
def _load_preset(key: str) -> Sensor:
    return load_sensor(PRESET_FILES[key])


HDL64E = _load_preset("hdl64e")
SENSORS: dict[str, Sensor] = {"hdl64e": HDL64E}  # loaded presets; others are loaded from PRESET_FILES on demand
SENSOR_NAMES = tuple(path.stem for path in PRESET_FILES.values())
GENERIC_FORMAT = "generic:BEAMS,LOWEST,HIGHEST,STEP,RATE (degrees, revolutions per second)"


def find_sensor(name: str, height: float = 0.0) -> Sensor:
    """Find a sensor by its name.

    Args:
        name: Preset in any spelling (vlp-16, VLP16), YAML file (see load_sensor), or generic sensor
            (see GENERIC_FORMAT).
        height: Height above the ground in m; 0 uses the default height of the sensor.

    Raises:
        InputError: The sensor is unknown; the message lists the presets.
    """
    sensor = _find_by_name(name)
    return replace(sensor, height=height) if height else sensor


def _find_by_name(name: str) -> Sensor:
    if name.startswith("generic:"):
        try:
            beams, *numbers = map(float, name.removeprefix("generic:").split(","))
            if beams % 1:  # also true for NaN
                raise ValueError
            return make_generic_sensor(int(beams), *numbers)
        except (TypeError, ValueError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"invalid sensor {name!r}: expected {GENERIC_FORMAT}, such as generic:32,-25,15,0.2,10"
            ) from None
    if name.endswith((".yaml", ".yml")):
        return load_sensor(name)
    if name in SENSORS:
        return SENSORS[name]
    if _normalize_name(name) not in PRESET_FILES:
        raise InputError(
            f"unknown sensor {name!r}: must be one of {', '.join(SENSOR_NAMES)}, a "
            f".yaml file, or {GENERIC_FORMAT}{suggest_name(name, SENSOR_NAMES)}"
        )
    return _load_preset(_normalize_name(name))
