"""Options for parameters (--config, --set) and for the detector (--weights, --range, --device).

@click.command(cls=Command)
@detector_options()
def command(detector: DetectorChoice): detector.open(sensor_height=1.73)
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import click

from lidar_perception.candidates.configurations import CONFIGURATIONS, PAPER
from lidar_perception.cli.command import Choice, OptionWithHelp
from lidar_perception.cli.parameter_files import Fields, parse_value, read_parameters
from lidar_perception.detectors.contract import FUSED
from lidar_perception.detectors.open import DetectorChoice, make_default_params
from lidar_perception.detectors.params import RANGE_CHOICES
from lidar_perception.nodes import NODES
from lidar_perception.nodes.node_parameters import find_node_parameters
from lidar_perception.param_fields import collect_fields, describe_fields, with_values
from lidar_perception.runs.terminal import errors
from lidar_perception.tracking.params import TrackingParams
from lidar_perception.types import InputError, suggest_name

CANDIDATES = "candidates"
CANDIDATE_NODES = "perception", "ground_segmentation", "clustering", "candidate_refinement"


@dataclass(frozen=True)
class Algorithm:
    """An algorithm whose parameters can be set.

    Attributes:
        name: shown in messages.
        fields: its parameters by dotted name.
        nodes: nodes whose sections of a parameter file apply; None: all.
    """

    name: str
    fields: Fields
    nodes: Collection[str] | None


@dataclass(frozen=True)
class Settings:
    """Values of --config and --set, not yet checked against a detector."""

    config: Path | None
    assignments: tuple[tuple[str, str], ...]

    def resolve(self, *algorithms: Algorithm) -> list[dict[str, Any]]:
        """Return {dotted name: value} for each algorithm; --set takes precedence over --config.

        Raises:
            InputError: no algorithm has a parameter of --set, or a file cannot be used.
        """
        fields_by_name = {name: f for algorithm in algorithms for name, f in algorithm.fields.items()}
        owners = " or ".join(dict.fromkeys(algorithm.name for algorithm in algorithms))
        for name, _ in self.assignments:
            if name not in fields_by_name and name.startswith("input."):
                raise InputError(f"{name} applies to messages read by nodes; a recording has its own intensity scale")
            if name not in fields_by_name:
                raise InputError(
                    f"unknown parameter {name[:80]!r} of {owners}{_suggest_parameter(name, fields_by_name)} "
                    "(--set help lists them all)"
                )
        config_values: list[dict[str, Any]] = [{} for _ in algorithms]
        if self.config is not None:
            contents = [read_parameters(self.config, algorithm.fields, algorithm.nodes) for algorithm in algorithms]
            config_values = [values for values, _ in contents]
            _warn(self.config, (line for _, lines in contents for line in lines))
            if not any(config_values):
                errors.print(f"{self.config} has no parameter of {owners}", style="yellow")
        return [
            {
                **values,
                **{
                    name: parse_value(name, algorithm.fields[name], text)
                    for name, text in self.assignments
                    if name in algorithm.fields
                },
            }
            for algorithm, values in zip(algorithms, config_values)
        ]

    def __bool__(self) -> bool:
        return self.config is not None or bool(self.assignments)


def _suggest_parameter(name: str, fields: Fields) -> str:
    """Return the end of an error message that suggests the parameter with the closest name."""
    members = [key for key in fields if key.startswith(f"{name}.")]
    if members:
        return f", which is a group with {', '.join(members)}"
    matches = [key for key in fields if key.endswith(f".{name}")]
    return f"; did you mean {matches[0]!r}?" if len(matches) == 1 else suggest_name(name, fields)


class Assignment(click.ParamType):
    """Option value of the form NAME=VALUE, or NAME:=VALUE as in ROS."""

    name = "assignment"

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[str, str]:
        if isinstance(value, tuple):
            return value
        name, separator, text = str(value).partition("=")
        if not separator and value != "help":
            self.fail(
                f"{value!r} must be NAME=VALUE, such as fused.scores.car=0.7; --set help lists all names", param, ctx
            )
        return name.removesuffix(":").strip(), text


def _suggest_assignment(flag: str) -> str:
    """Return how to set the parameter of a node that an unknown flag names; "" if there is none."""
    parameter = flag.removeprefix("--").removeprefix("no-")
    names_by_flag = {
        name.replace(".", "-").replace("_", "-"): name for node in NODES for name in find_node_parameters(node)
    }
    return f"; parameters are given as --set {names_by_flag[parameter]}=VALUE" if parameter in names_by_flag else ""


def settings_options(
    select: Callable[[Mapping[str, Any]], list[Algorithm]],
    example: str = "fused.scores.car=0.7",
    candidates: bool = False,
) -> Callable:
    """Return a decorator that adds --config and --set.

    The decorated function receives them as `settings`, a Settings.

    Args:
        select: returns the algorithms that the options select, for `--set help`.
        example: assignment to show in the help.
        candidates: True if the candidate pipeline, which has named configurations, can be selected.
    """
    config_note = f" Or one of {', '.join(CONFIGURATIONS)}, for the candidates." if candidates else ""

    def list_parameters(options: Mapping[str, Any]) -> str:
        return "\n".join(
            line
            for algorithm in select(options)
            for line in (f"Parameters of {algorithm.name}:", *describe_fields(algorithm.fields))
        )

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(*args: Any, config: Path | None, assignments: tuple, **kwargs: Any) -> Any:
            return function(*args, settings=Settings(config, assignments), **kwargs)

        wrapper = click.option(
            "--set",
            "assignments",
            cls=OptionWithHelp,
            list_values=list_parameters,
            suggest=_suggest_assignment,
            multiple=True,
            type=Assignment(),
            metavar="NAME=VALUE",
            help=f"Set a parameter, such as {example}; may be repeated. "
            "`--set help` lists all, with units and defaults.",
        )(wrapper)
        return click.option(
            "--config",
            type=click.Path(path_type=Path),
            metavar="FILE|NAME" if config_note else "FILE",
            help=f"ROS parameter file, as in config/; --set takes precedence.{config_note}",
        )(wrapper)

    return decorate


def make_candidate_algorithm(in_nodes: bool = False) -> Algorithm:
    """Return the parameters of the candidate pipeline.

    Args:
        in_nodes: True to include the parameters of input messages.
    """
    fields = collect_fields(PAPER)
    return Algorithm(CANDIDATES, fields if in_nodes else _drop_input_fields(fields), CANDIDATE_NODES)


def parameter_options(
    defaults: Any,
    name: str = CANDIDATES,
    nodes: Collection[str] | None = CANDIDATE_NODES,
    example: str = "stm.threshold=0.5",
) -> Callable:
    """Return a decorator that adds --config and --set for a parameter dataclass.

    The decorated function receives the resulting dataclass as `params`.

    Args:
        defaults: dataclass with the default values.
        name: name of the algorithm in messages.
        nodes: nodes whose sections of a parameter file apply; None: all.
        example: assignment to show in the help.
    """
    algorithm = Algorithm(name, _drop_input_fields(collect_fields(defaults)), nodes)

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(*args: Any, settings: Settings, **kwargs: Any) -> Any:
            return function(*args, params=apply_values(defaults, settings.resolve(algorithm)[0]), **kwargs)

        return settings_options(lambda _: [algorithm], example, name == CANDIDATES)(wrapper)

    return decorate


def apply_values(params: Any, values: Mapping[str, Any]) -> Any:
    """Return params with these values.

    Raises:
        InputError: a name is unknown or a value is out of range.
    """
    try:
        return with_values(params, dict(values))
    except ValueError as error:
        raise InputError(str(error)) from None


def list_weights(options: Mapping[str, Any]) -> list[str]:
    """Return the values of --weights as a list."""
    weights = options.get("weights") or ()
    return [*map(str, weights)] if isinstance(weights, tuple) else [str(weights)]


def make_detector_algorithm(weights: str | Path, in_nodes: bool = False) -> Algorithm:
    """Return the parameters of the detector that a value of --weights selects.

    Args:
        in_nodes: True to include the parameters of input messages.

    Raises:
        InputError: the detector is unknown.
    """
    params = make_default_params(weights)
    name = str(weights)
    node = next((f"{f.name}_detector" for f in fields(params) if f"{f.name}_detector" in NODES), name)
    param_fields = collect_fields(params)
    return Algorithm(name, param_fields if in_nodes else _drop_input_fields(param_fields), (node,))


def _drop_input_fields(fields: Fields) -> Fields:
    """Drop the parameters of input messages, which only nodes read."""
    return {name: f for name, f in fields.items() if not name.startswith("input.")}


@dataclass(frozen=True)
class TrackerParams:
    """Parameters of the tracker, named as in its node."""

    tracking: TrackingParams = TrackingParams()


TRACKER = Algorithm("the tracker", collect_fields(TrackerParams()), ("tracker",))

range_option = click.option(
    "--range",
    type=Choice(RANGE_CHOICES),
    default="auto",
    show_default=True,
    help="Range of the detector: ahead (69 m), or around (51 m in all directions), which takes more than twice as "
    "long. auto: the range that the weights were trained for (shipped weights: ahead).",
)
device_option = click.option(
    "--device", default="auto", show_default=True, help="Device to run networks on: auto, cpu, cuda or cuda:N."
)


def detector_options(*, default: str | None = FUSED, tracking: bool = False) -> Callable:
    """Return a decorator that adds --weights, --range, --device, --config and --set.

    The decorated function receives them as `detector`, a DetectorChoice.

    Args:
        default: detector without --weights; if None, `detector` may be None. `detector` is also None
            if the command has an option --results and it is given.
        tracking: True to accept parameters of the tracker as well. The function receives them as
            `tracking`, a TrackingParams.
    """
    tracker = [TRACKER] if tracking else []

    def select(options: Mapping[str, Any]) -> list[Algorithm]:
        return [*map(make_detector_algorithm, list_weights(options) or [FUSED]), *tracker]

    def decorate(function: Callable) -> Callable:
        @functools.wraps(function)
        def wrapper(
            *args: Any, weights: Path | None, range: str, device: str, settings: Settings, **kwargs: Any
        ) -> Any:
            results = kwargs.get("results")
            if results is not None and (weights is not None or settings or range != "auto"):
                metavar = next(p.metavar for p in click.get_current_context().command.params if p.name == "results")
                raise click.UsageError(
                    f"give either --results {metavar}, or --weights with --range, --config and --set"
                )
            name = str(weights) if weights else None if results else default
            if name is None and settings:
                raise click.UsageError("--config and --set require --weights")
            values: list[dict[str, Any]] = [{}, {}]
            if name is not None:
                values = settings.resolve(make_detector_algorithm(name), *tracker) if settings else values
            if tracking:
                kwargs["tracking"] = apply_values(TrackerParams(), values[1]).tracking
            choice = None if name is None else make_detector_choice(name, range, device, values[0])
            return function(*args, detector=choice, **kwargs)

        wrapper = settings_options(select)(wrapper)
        for option in device_option, range_option, weights_option(default):
            wrapper = option(wrapper)
        return wrapper

    return decorate


def detectors_options(function: Callable) -> Callable:
    """Add the options of detector_options for any number of detectors.

    The decorated function receives them as `detectors`, a tuple of DetectorChoice. Each parameter of
    --set must belong to at least one of them.
    """

    @functools.wraps(function)
    def wrapper(
        *args: Any, weights: tuple[Path, ...], range: str, device: str, settings: Settings, **kwargs: Any
    ) -> Any:
        if settings and not weights:
            raise click.UsageError("--config and --set require --weights")
        values = settings.resolve(*map(make_detector_algorithm, weights)) if settings else [{} for _ in weights]
        choices = tuple(make_detector_choice(name, range, device, params) for name, params in zip(weights, values))
        return function(*args, detectors=choices, **kwargs)

    wrapper = settings_options(lambda options: [*map(make_detector_algorithm, list_weights(options) or [FUSED])])(
        wrapper
    )
    for option in device_option, range_option, weights_option(multiple=True):
        wrapper = option(wrapper)
    return wrapper


def make_detector_choice(
    weights: str | Path, range: str, device: str, values: Mapping[str, Any], params: Any = None
) -> DetectorChoice:
    """Return a DetectorChoice with validated parameters. The detector is opened later.

    Args:
        params: default parameters of a detector that open_detector does not support.
    """
    if values:
        apply_values(make_default_params(weights) if params is None else params, values)
    return DetectorChoice(str(weights), range, device, dict(values))


def weights_option(default: str | None = None, multiple: bool = False) -> Callable:
    """Return the option --weights, which may be repeated if `multiple` is True."""
    note = " May be repeated." if multiple else f" Default: {default}." if default else ""
    return click.option(
        "--weights",
        type=click.Path(path_type=Path),
        metavar="FILE|NAME",
        multiple=multiple,
        help="Detector: a checkpoint; the file that `train fused` wrote; fused, pointpillars or pointnet with the "
        f"shipped weights; or your own class, module:Class.{note}",
    )


def read_config(path: Path, params: Any, nodes: Collection[str] | None = None) -> dict[str, Any]:
    """Read a parameter file (see read_parameters) and print names that may be misspelt.

    Args:
        params: a dataclass of parameters, or its fields.
    """
    fields = params if isinstance(params, Mapping) else collect_fields(params)
    values, lines = read_parameters(path, fields, nodes)
    _warn(path, lines)
    return values


def _warn(path: Path, lines: Iterable[str]) -> None:
    for line in dict.fromkeys(lines):
        errors.print(f"{path}: {line}", style="yellow")
