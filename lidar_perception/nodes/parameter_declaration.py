"""Declaration of dataclass fields as ROS parameters, with types, ranges and descriptions."""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from lidar_perception.nodes.rclpy_compat import get_parameter_overrides, store_empty_list
from lidar_perception.param_fields import collect_fields, with_values

TYPES = {
    bool: Parameter.Type.BOOL,
    int: Parameter.Type.INTEGER,
    float: Parameter.Type.DOUBLE,
    str: Parameter.Type.STRING,
}
LISTS = {int: Parameter.Type.INTEGER_ARRAY, float: Parameter.Type.DOUBLE_ARRAY, str: Parameter.Type.STRING_ARRAY}
# (type of the value, declared type) -> function that converts the value.
TO_FLOATS: dict[tuple[Any, Any], Any] = {
    (Parameter.Type.INTEGER, Parameter.Type.DOUBLE): float,
    (Parameter.Type.INTEGER_ARRAY, Parameter.Type.DOUBLE_ARRAY): lambda v: [*map(float, v)],
}


def declare_parameters(node: Node, params: Any) -> Any:
    """Declare the fields of a dataclass as ROS parameters of a node.

    Returns:
        params with the values that the user has set.

    Raises:
        ValueError: a value is out of range.
    """
    values, overrides = {}, get_parameter_overrides(node)
    for name, f in collect_fields(params).items():
        kind = _find_type(f)
        value = list(f.default) if isinstance(f.default, tuple) else f.default
        if name in overrides:
            override = convert_to_declared_type(overrides.pop(name), kind)
            if override.value == []:
                value = []
            else:
                overrides[name] = override
        values[name] = node.declare_parameter(name, kind if value == [] else value, _make_descriptor(f, kind)).value
        if values[name] is None:
            store_empty_list(node, name, kind)
            values[name] = []
    return with_values(params, values)


def convert_to_declared_type(parameter: Parameter, kind: Parameter.Type) -> Parameter:
    """Convert integers to float if the declared type is float, and empty lists, which have no type."""
    if kind in LISTS.values() and (
        parameter.type_ == Parameter.Type.NOT_SET
        or (parameter.type_.name.endswith("_ARRAY") and len(parameter.value) == 0)
    ):
        return Parameter(parameter.name, kind, [])
    convert = TO_FLOATS.get((parameter.type_, kind))
    return Parameter(parameter.name, kind, convert(parameter.value)) if convert else parameter


def _find_type(f: Any) -> Parameter.Type:
    return LISTS[f.metadata["item"]] if isinstance(f.default, tuple) else TYPES[type(f.default)]


def _make_descriptor(f: Any, kind: Parameter.Type) -> ParameterDescriptor:
    metadata = f.metadata
    unit = f" [{metadata['unit']}]" if metadata["unit"] else ""
    choices = f"one of {', '.join(metadata['choices'])}" if metadata["choices"] else ""
    descriptor = ParameterDescriptor(
        description=metadata["doc"] + unit, read_only=metadata["fixed"], type=kind.value, additional_constraints=choices
    )
    low, high = metadata["low"], metadata["high"]
    if low is not None or high is not None:
        if kind == Parameter.Type.DOUBLE:
            descriptor.floating_point_range = [
                FloatingPointRange(
                    from_value=float(-1e300 if low is None else low), to_value=float(1e300 if high is None else high)
                )
            ]
        elif kind == Parameter.Type.INTEGER:
            descriptor.integer_range = [
                IntegerRange(from_value=-(2**62) if low is None else low, to_value=2**62 if high is None else high)
            ]
    return descriptor
