"""--config and --set: the parameters of what runs. --weights, --range, --device: the detector.

@click.command(cls=Command)
@detector_options()
def verb(detector: DetectorChoice): detector.open(sensor_height=1.73)
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import Field, dataclass, fields
from pathlib import Path
from typing import Any

import click

from lidar_perception.candidates.configurations import CONFIGURATIONS, PAPER
from lidar_perception.cli.command import Choice, HelpfulOption
from lidar_perception.cli.parameter_files import Fields, read_parameters
from lidar_perception.detectors.contract import FUSED
from lidar_perception.detectors.open import DetectorChoice, default_params
from lidar_perception.detectors.params import RANGE_CHOICES
from lidar_perception.nodes import NODES
from lidar_perception.nodes.node_parameters import find_node_parameters
from lidar_perception.param_fields import collect_fields, describe_fields, with_values
from lidar_perception.runs.terminal import errors
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import InputError, did_you_mean

CANDIDATES = "candidates"
CANDIDATE_NODES = "perception", "ground_segmentation", "clustering", "candidate_refinement"
ON_OFF = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


@dataclass(frozen=True)
class Runs:
    """Something that runs, with parameters: its name, their fields by dotted name, and the nodes
    whose sections of a parameter file apply to it (None: all)."""

    name: str
    fields: Fields
    nodes: Collection[str] | None


@dataclass(frozen=True)
class Settings:
    """Values of --config and --set, not yet checked against a detector."""

    config: Path | None
    given: tuple[tuple[str, str], ...]

    def values(self, *runs: Runs) -> list[dict[str, Any]]:
        """Return {dotted name: value} for each of several things that run; --set wins.

        Raises:
            InputError: a parameter of --set is of none of them, or a file cannot be used.
        """
        known = {name: f for each in runs for name, f in each.fields.items()}
        whose = " or ".join(dict.fromkeys(each.name for each in runs))
        for name, _ in self.given:
            if name not in known and name.startswith("input."):
                raise InputError(f"{name} applies to messages read by nodes; a recording has its own intensity scale")
            if name not in known:
                raise InputError(
                    f"unknown parameter {name[:80]!r} of {whose}{_guess(name, known)} (--set help lists them all)"
                )
        found: list[dict[str, Any]] = [{} for _ in runs]
        if self.config is not None:
            read = [read_parameters(self.config, each.fields, each.nodes) for each in runs]
            found = [values for values, _ in read]
            _warn(self.config, (line for _, lines in read for line in lines))
            if not any(found):
                errors.print(f"{self.config} has no parameter of {whose}", style="yellow")
        return [
            {
                **values,
                **{name: _value(name, each.fields[name], text) for name, text in self.given if name in each.fields},
            }
            for each, values in zip(runs, found)
        ]

    def __bool__(self) -> bool:
        return self.config is not None or bool(self.given)


def _guess(name: str, known: Fields) -> str:
    """Return the end of a message: the parameter with the closest name, or with this last part."""
    inner = [each for each in known if each.startswith(f"{name}.")]
    if inner:
        return f", which is a group with {', '.join(inner)}"
    ends = [each for each in known if each.endswith(f".{name}")]
    return f"; did you mean {ends[0]!r}?" if len(ends) == 1 else did_you_mean(name, known)


def _value(name: str, f: Field[Any], text: str) -> Any:
    """Convert the text of a parameter to its type."""
    kind = f.metadata["item"] or type(f.default)
    try:
        if not isinstance(f.default, tuple):
            return _scalar(kind, text)
        inner = text.strip().removeprefix("[").removesuffix("]")
        return tuple(_scalar(kind, word.strip()) for word in inner.split(",") if word.strip())
    except (ValueError, KeyError):
        many = (
            "a list of numbers, e.g. 0.15,0.3"
            if isinstance(f.default, tuple)
            else {bool: "true or false", int: "a whole number", float: "a number"}[kind]
        )
        raise InputError(f"--set {name}={text[:80]}: the value must be {many}") from None


def _scalar(kind: type, text: str) -> Any:
    return ON_OFF[text.lower()] if kind is bool else kind(text)


class Assignment(click.ParamType):
    """NAME=VALUE, or NAME:=VALUE as in ROS."""

    name = "assignment"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, str]:
        if isinstance(value, tuple):
            return value
        name, equals, text = str(value).partition("=")
        if not equals and value != "help":
            self.fail(
                f"{value!r} must be NAME=VALUE, such as fused.scores.car=0.7; --set help lists all names", param, ctx
            )
        return name.removesuffix(":").strip(), text


class SetOption(HelpfulOption):
    """The option --set. runs: returns what runs for the options that were given."""

    def __init__(self, *args: Any, runs: Callable[[Mapping[str, Any]], list[Runs]], **more: Any):
        super().__init__(*args, **more)
        self.runs = runs

    def listing(self, given: Mapping[str, Any]) -> str:
        return "\n".join(
            line for each in self.runs(given) for line in (f"Parameters of {each.name}:", *describe_fields(each.fields))
        )

    def suggest_option(self, flag: str) -> str:
        plain = flag.removeprefix("--").removeprefix("no-")
        known = {
            name.replace(".", "-").replace("_", "-"): name for node in NODES for name in find_node_parameters(node)
        }
        return f"; parameters are given as --set {known[plain]}=VALUE" if plain in known else ""


def settings_options(
    runs: Callable[[Mapping[str, Any]], list[Runs]], example: str = "fused.scores.car=0.7", candidates: bool = False
) -> Callable:
    """Decorator: --config and --set, which the function gets as settings=Settings(...).

    Args:
        runs: returns what runs for the options that were given, for `--set help`.
        example: of --set, for the help.
        candidates: the candidates may run, which have named configurations.
    """
    named = f" Or one of {', '.join(CONFIGURATIONS)}, for the candidates." if candidates else ""

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(*args: Any, config: Path | None, given: tuple, **kwargs: Any) -> Any:
            return function(*args, settings=Settings(config, given), **kwargs)

        wrapper = click.option(
            "--set",
            "given",
            cls=SetOption,
            runs=runs,
            multiple=True,
            type=Assignment(),
            metavar="NAME=VALUE",
            help=f"Set a parameter, such as {example}; may be repeated. "
            "`--set help` lists all, with units and defaults.",
        )(wrapper)
        return click.option(
            "--config",
            type=click.Path(path_type=Path),
            metavar="FILE|NAME" if named else "FILE",
            help=f"ROS parameter file, as in config/; --set takes precedence.{named}",
        )(wrapper)

    return decorate


def make_candidate_runs(on_messages: bool = False) -> Runs:
    """Return the candidate pipeline with its parameters; on_messages: it runs in nodes."""
    return Runs(CANDIDATES, _read_here(collect_fields(PAPER), on_messages), CANDIDATE_NODES)


def parameter_options(
    defaults: Any,
    name: str = CANDIDATES,
    nodes: Collection[str] | None = CANDIDATE_NODES,
    example: str = "stm.threshold=0.5",
) -> Callable:
    """Decorator: --config and --set of one dataclass of parameters, which the function gets as
    params=."""
    runs = Runs(name, _read_here(collect_fields(defaults), on_messages=False), nodes)

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(*args: Any, settings: Settings, **kwargs: Any) -> Any:
            return function(*args, params=checked(defaults, settings.values(runs)[0]), **kwargs)

        return settings_options(lambda _: [runs], example, name == CANDIDATES)(wrapper)

    return decorate


def checked(params: Any, values: Mapping[str, Any]) -> Any:
    """Return params with these values.

    Raises:
        InputError: a name is unknown or a value is out of range.
    """
    try:
        return with_values(params, dict(values))
    except ValueError as error:
        raise InputError(str(error)) from None


def weights_of(given: Mapping[str, Any]) -> list[str]:
    """Return the values of --weights as a list."""
    weights = given.get("weights") or ()
    return [*map(str, weights)] if isinstance(weights, tuple) else [str(weights)]


def make_runs(weights: str | Path, on_messages: bool = False) -> Runs:
    """Return the parameters of the detector that a value of --weights selects.

    Args:
        on_messages: the detector runs in a node, so it has the parameters of input messages, too.

    Raises:
        InputError: there is no such detector.
    """
    params = default_params(weights)
    name = str(weights)
    node = next((f"{f.name}_detector" for f in fields(params) if f"{f.name}_detector" in NODES), name)
    return Runs(name, _read_here(collect_fields(params), on_messages), (node,))


def _read_here(fields: Fields, on_messages: bool) -> Fields:
    """Return the fields without those of input messages, unless messages are read."""
    return {name: f for name, f in fields.items() if on_messages or not name.startswith("input.")}


@dataclass(frozen=True)
class Tracked:
    """Parameters of the tracker, named as in its node."""

    tracking: TrackingParams = TrackingParams()


TRACKER = Runs("the tracker", collect_fields(Tracked()), ("tracker",))

range_option = click.option(
    "--range",
    type=Choice(RANGE_CHOICES),
    default="auto",
    show_default=True,
    help="Range of the detector: 69 m ahead, or 51 m in all directions, which takes more than twice as long. auto: "
    "the range that its weights were trained for (shipped weights: ahead).",
)
device_option = click.option(
    "--device", default="auto", show_default=True, help="Where networks run: auto, cpu, cuda or cuda:N."
)


def detector_options(*, default: str | None = FUSED, tracking: bool = False) -> Callable:
    """Decorator: --weights, --range, --device, --config and --set, which the function gets as
    detector=DetectorChoice(...).

    Args:
        default: the detector without --weights; None: the function gets detector=None. So it does
            where the verb has an option --results, and that is given.
        tracking: parameters of the tracker can be set too, and the function gets
            tracking=TrackingParams(...).
    """
    others = [TRACKER] if tracking else []

    def runs(given: Mapping[str, Any]) -> list[Runs]:
        return [*map(make_runs, weights_of(given) or [FUSED]), *others]

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(
            *args: Any, weights: Path | None, range: str, device: str, settings: Settings, **kwargs: Any
        ) -> Any:
            results = kwargs.get("results")
            if results is not None and (weights is not None or settings or range != "auto"):
                form = next(p.metavar for p in click.get_current_context().command.params if p.name == "results")
                raise click.UsageError(f"give either --results {form}, or --weights with --range, --config and --set")
            name = str(weights) if weights else None if results else default
            if name is None and settings:
                raise click.UsageError("--config and --set require --weights")
            values: list[dict[str, Any]] = [{}, {}]
            if name is not None:
                values = settings.values(make_runs(name), *others) if settings else values
            if tracking:
                kwargs["tracking"] = checked(Tracked(), values[1]).tracking
            chosen = None if name is None else make_detector_choice(name, range, device, values[0])
            return function(*args, detector=chosen, **kwargs)

        wrapper = settings_options(runs)(wrapper)
        for option in device_option, range_option, weights_option(default):
            wrapper = option(wrapper)
        return wrapper

    return decorate


def detectors_options(function: Callable) -> Callable:
    """Decorator: the options of detector_options for any number of detectors.

    The function gets them as detectors=(DetectorChoice(...), ...). Each parameter of --set must
    belong to at least one of them.
    """

    @functools.wraps(function)
    def wrapper(
        *args: Any, weights: tuple[Path, ...], range: str, device: str, settings: Settings, **kwargs: Any
    ) -> Any:
        if settings and not weights:
            raise click.UsageError("--config and --set require --weights")
        values = settings.values(*map(make_runs, weights)) if settings else [{} for _ in weights]
        chosen = tuple(make_detector_choice(name, range, device, own) for name, own in zip(weights, values))
        return function(*args, detectors=chosen, **kwargs)

    wrapper = settings_options(lambda given: [*map(make_runs, weights_of(given) or [FUSED])])(wrapper)
    for option in device_option, range_option, weights_option(multiple=True):
        wrapper = option(wrapper)
    return wrapper


def make_detector_choice(
    weights: str | Path, range: str, device: str, values: Mapping[str, Any], params: Any = None
) -> DetectorChoice:
    """Return a detector to open later, with parameters that are checked now.

    Args:
        params: default parameters, for a detector that open_detector does not know.
    """
    if values:
        checked(default_params(weights) if params is None else params, values)
    return DetectorChoice(str(weights), range, device, dict(values))


def weights_option(default: str | None = None, multiple: bool = False) -> Callable:
    """Return the option --weights; with `multiple` it may be repeated."""
    more = " May be repeated." if multiple else f" Default: {default}." if default else ""
    return click.option(
        "--weights",
        type=click.Path(path_type=Path),
        metavar="FILE|NAME",
        multiple=multiple,
        help="The detector: a checkpoint, the output of `train fused`, one of fused, pointpillars "
        "and pointnet with its shipped weights, or a class of your own, "
        f"module:Class.{more}",
    )


def read_config(path: Path, known: Any, nodes: Collection[str] | None = None) -> dict[str, Any]:
    """Read a parameter file, see read_parameters, and print names that may be misspelt.

    Args:
        known: a dataclass of parameters, or its fields.
    """
    fields = known if isinstance(known, Mapping) else collect_fields(known)
    values, lines = read_parameters(path, fields, nodes)
    _warn(path, lines)
    return values


def _warn(path: Path, lines: Iterable[str]) -> None:
    for line in dict.fromkeys(lines):
        errors.print(f"{path}: {line}", style="yellow")
