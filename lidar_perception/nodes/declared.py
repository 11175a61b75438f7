"""Parameters of a dataclass as ROS parameters: types, ranges, texts; 1 is taken for 1.0."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from lidar_perception.param_fields import collect_fields, with_values

TYPES = {bool: Parameter.Type.BOOL, int: Parameter.Type.INTEGER, float: Parameter.Type.DOUBLE,
         str: Parameter.Type.STRING}
LISTS = {int: Parameter.Type.INTEGER_ARRAY, float: Parameter.Type.DOUBLE_ARRAY,
         str: Parameter.Type.STRING_ARRAY}
# What is given, what is declared -> the value as declared.
AS_FLOATS: dict[tuple[Any, Any], Any] = {
    (Parameter.Type.INTEGER, Parameter.Type.DOUBLE): float,
    (Parameter.Type.INTEGER_ARRAY, Parameter.Type.DOUBLE_ARRAY): lambda v: [*map(float, v)],
}


def declare(node: Node, params: Any) -> Any:
    """Declare the fields of params, a dataclass, and return params with the values that the node
    was given.

    Raises: ValueError for a value out of range."""
    declared = {}
    for name, f in collect_fields(params).items():
        kind = _kind(f)
        value = list(f.default) if isinstance(f.default, tuple) else f.default
        if name in node._parameter_overrides:
            given = as_declared(node._parameter_overrides.pop(name), kind)
            if given.value == []:
                value = []
            else:
                node._parameter_overrides[name] = given
        declared[name] = node.declare_parameter(name, kind if value == [] else value,
                                                _descriptor(f, kind)).value
        if declared[name] is None:
            # rclpy takes an empty list for one of bytes, and what is declared by its type alone is
            # "not set", which get_parameters answers with nothing at all for all of its names.
            node._parameters[name] = Parameter(name, kind, [])
            declared[name] = []
    return with_values(params, declared)


def as_declared(given: Parameter, kind: Parameter.Type) -> Parameter:
    """Whole numbers as floats where the declared type is float, and an empty list, which has no
    type, as one of the declared type; all else as given."""
    if kind in LISTS.values() and (given.type_ == Parameter.Type.NOT_SET or (
            given.type_.name.endswith("_ARRAY") and len(given.value) == 0)):
        return Parameter(given.name, kind, [])
    convert = AS_FLOATS.get((given.type_, kind))
    return Parameter(given.name, kind, convert(given.value)) if convert else given


def _kind(f: Any) -> Parameter.Type:
    return LISTS[f.metadata["item"]] if isinstance(f.default, tuple) else TYPES[type(f.default)]


def _descriptor(f: Any, kind: Parameter.Type) -> ParameterDescriptor:
    limits = f.metadata
    unit = f" [{limits['unit']}]" if limits["unit"] else ""
    choices = f"one of {', '.join(limits['choices'])}" if limits["choices"] else ""
    descriptor = ParameterDescriptor(description=limits["doc"] + unit, read_only=limits["fixed"],
                                     type=kind.value, additional_constraints=choices)
    low, high = limits["low"], limits["high"]
    if low is not None or high is not None:
        if kind == Parameter.Type.DOUBLE:
            descriptor.floating_point_range = [FloatingPointRange(
                from_value=float(-1e300 if low is None else low),
                to_value=float(1e300 if high is None else high), step=0.0)]
        elif kind == Parameter.Type.INTEGER:
            descriptor.integer_range = [IntegerRange(
                from_value=-2**62 if low is None else low,
                to_value=2**62 if high is None else high, step=0)]
    return descriptor
