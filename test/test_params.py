"""Parameters: values in range are kept, others are rejected by name."""

from __future__ import annotations

import dataclasses
import math

import pytest
from samples import for_all

from lidar_perception import params as node_params
from lidar_perception.candidates import params as candidate_params
from lidar_perception.candidates.params import PipelineParams
from lidar_perception.cli.options import read_config
from lidar_perception.clustering import params as clustering_params
from lidar_perception.clustering.params import DbscanParams
from lidar_perception.detectors import params as detector_params
from lidar_perception.detectors.pointnet import params as pointnet_params
from lidar_perception.detectors.pointnet.params import PointNetDetectorParams
from lidar_perception.detectors.pointpillars import params as pointpillars_params
from lidar_perception.detectors.pointpillars.params import DetectorParams
from lidar_perception.ground import params as ground_params
from lidar_perception.ground.params import ThresholdParams
from lidar_perception.param_fields import Params, collect_fields, flatten, with_values
from lidar_perception.params import (
    ClusteringNodeParams,
    GroundNodeParams,
    PlayerParams,
    RefinementNodeParams,
    TrackerNodeParams,
)
from lidar_perception.robot import params as robot_params
from lidar_perception.tracking import params as tracking_params
from lidar_perception.training import params as training_params
from lidar_perception.training.params import PointPillarsTraining
from lidar_perception.types import InputError
from lidar_perception.wire import params as wire_params

MODULES = (
    node_params,
    candidate_params,
    clustering_params,
    detector_params,
    ground_params,
    robot_params,
    wire_params,
    tracking_params,
    pointpillars_params,
    pointnet_params,
    training_params,
)


def find_groups(base: type) -> list[type]:
    return [group for kind in base.__subclasses__() for group in (kind, *find_groups(kind))]


GROUPS = [group for group in find_groups(Params) if group.__module__ in [module.__name__ for module in MODULES]]
COMPOSITES = [
    TrackerNodeParams,
    PipelineParams,
    GroundNodeParams,
    ClusteringNodeParams,
    RefinementNodeParams,
    DetectorParams,
    PointNetDetectorParams,
    PointPillarsTraining,
]
FIELDS = [
    pytest.param(group, f, id=f"{group.__name__}.{f.name}")
    for group in GROUPS
    for f in dataclasses.fields(group)
    if f.metadata
]

each_field = for_all(FIELDS)
each_params = for_all([*GROUPS, *COMPOSITES])


def get_type(f: dataclasses.Field) -> type:
    return f.metadata["item"] or type(f.default)


def to_field_value(f: dataclasses.Field, value):
    """Return the value for a scalar field, or a list as long as the default that starts with it."""
    return (value, *f.default[1:]) if f.metadata["item"] else value


def list_bounded_fields(limit: str) -> list:
    return [p for p in FIELDS if p.values[1].metadata[limit] is not None]


def get_step(f: dataclasses.Field) -> float:
    return 1 if get_type(f) is int else 0.5


def other_value(f: dataclasses.Field):
    """Return a value in range that is not the default."""
    if f.metadata["choices"]:
        return next(c for c in f.metadata["choices"] if c != f.default)
    if f.name in ("body", "sectors"):  # lists of six numbers or of pairs; empty by default
        return (-1.0, -1.0, -1.0, 1.0, 1.0, 1.0)
    if f.metadata["item"]:
        return (*f.default, "/more") if get_type(f) is str else tuple(v + 1.0 for v in f.default)
    if isinstance(f.default, bool):
        return not f.default
    if isinstance(f.default, str):
        return f.default + "other"
    high = f.metadata["high"]
    return f.default + 1 if high is None or f.default + 1 <= high else f.default / 2


def config(tmp_path, text: str, params=None):
    path = tmp_path / "params.yaml"
    path.write_text(text)
    return read_config(path, params or PipelineParams())


def test_every_parameter_group_is_tested():
    public = [
        v
        for module in MODULES
        for v in vars(module).values()
        if isinstance(v, type) and dataclasses.is_dataclass(v) and v.__module__ in [m.__name__ for m in MODULES]
    ]
    assert {*public} == {*GROUPS, *COMPOSITES}


@each_params
def test_defaults_are_valid(kind):
    params = kind()
    assert flatten(params) == {n: f.default for n, f in collect_fields(params).items()}


@each_field
def test_each_field_is_documented(group, f):
    assert f.metadata["doc"].endswith(".")
    assert get_type(f) in (bool, int, float, str)
    assert f.metadata["choices"] == () or f.default in f.metadata["choices"]


@each_params
def test_with_values_inverts_flatten(kind):
    changed_params = with_values(kind(), {n: other_value(f) for n, f in collect_fields(kind()).items()})
    assert changed_params != kind()
    assert with_values(kind(), flatten(changed_params)) == changed_params
    assert flatten(with_values(kind(), flatten(changed_params))) == flatten(changed_params)


@each_params
def test_with_values_keeps_other_values(kind):
    for name, f in collect_fields(kind()).items():
        if name.endswith(("eps", "range_limits")):
            continue  # the lengths of these fields depend on each other
        assert flatten(with_values(kind(), {name: other_value(f)})) == {**flatten(kind()), name: other_value(f)}


@for_all(list_bounded_fields("low"))
def test_error_below_the_range_names_field_and_range(group, f):
    value = f.metadata["low"] - get_step(f)
    with pytest.raises(ValueError) as error:
        group(**{f.name: to_field_value(f, value)})
    for word in (f.name, str(value), f"{f.metadata['low']} .. "):
        assert word in str(error.value)


@for_all(list_bounded_fields("high"))
def test_error_above_the_range_names_field_and_range(group, f):
    value = f.metadata["high"] + get_step(f)
    with pytest.raises(ValueError) as error:
        group(**{f.name: to_field_value(f, value)})
    for word in (f.name, str(value), f" .. {f.metadata['high']}"):
        assert word in str(error.value)


@for_all([p for p in list_bounded_fields("low") + list_bounded_fields("high") if not p.values[1].metadata["item"]])
def test_range_includes_its_limits(group, f):
    for limit in (f.metadata["low"], f.metadata["high"]):
        if limit is not None:
            assert getattr(group(**{f.name: get_type(f)(limit)}), f.name) == limit


@each_field
def test_error_of_a_wrong_type_names_field_and_type(group, f):
    wrong = {bool: [1, 0.0, "true"], int: [1.0, "1", True], float: ["1.0", True, 1j], str: [1, 2.0, True]}[get_type(f)]
    for value in [None, *wrong]:
        with pytest.raises(ValueError, match=f"^{f.name} = ") as error:
            group(**{f.name: to_field_value(f, value)})
        assert repr(value) in str(error.value)
        assert get_type(f).__name__ in str(error.value)


@for_all([p for p in FIELDS if p.values[1].metadata["item"]])
def test_scalar_for_a_list_is_rejected(group, f):
    for value in ("text", 1.0, None):
        with pytest.raises(ValueError, match=f"^{f.name} = .*must be a list"):
            group(**{f.name: value})


@for_all([p for p in FIELDS if get_type(p.values[1]) is float])
def test_nan_is_rejected(group, f):
    with pytest.raises(ValueError, match=f"^{f.name} is not a number"):
        group(**{f.name: to_field_value(f, math.nan)})


@for_all([p for p in FIELDS if p.values[1].metadata["choices"]])
def test_error_of_a_wrong_choice_lists_the_choices(group, f):
    with pytest.raises(ValueError, match=f"^{f.name} = 'nothing'") as error:
        group(**{f.name: "nothing"})
    assert all(choice in str(error.value) for choice in f.metadata["choices"])


def test_integers_become_floats():
    params = ThresholdParams(max_height=2)
    assert params.max_height == 2.0 and isinstance(params.max_height, float)
    eps = DbscanParams(eps=[1, 2, 3]).eps
    assert eps == (1.0, 2.0, 3.0) and all(isinstance(v, float) for v in eps)


@each_field
def test_parameters_cannot_be_changed_in_place(group, f):
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(group(), f.name, f.default)


@pytest.mark.parametrize("limits, eps", [((), (0.2,)), ((10.0,), (0.1, 0.2))])
def test_dbscan_accepts_any_number_of_bands(limits, eps):
    params = DbscanParams(range_limits=list(limits), eps=list(eps))
    assert (params.range_limits, params.eps) == (limits, eps)


def test_eps_must_have_one_value_more_than_range_limits():
    for eps in [(), (0.1, 0.2), (0.1, 0.2, 0.3, 0.4)]:
        with pytest.raises(ValueError, match=f"eps has {len(eps)} values for 2 range_limits"):
            DbscanParams(eps=eps)


@pytest.mark.parametrize("limits", [(30.0, 15.0), (15.0, 15.0)])
def test_range_limits_must_ascend(limits):
    with pytest.raises(ValueError, match=r"range_limits = \[.*must be in ascending order"):
        DbscanParams(range_limits=limits)


@pytest.mark.parametrize("value", [10**400, -(10**400), 2**63, float("inf")])
def test_huge_numbers_are_out_of_range(value):
    """Integers in YAML may be larger than any float."""
    with pytest.raises(ValueError, match=r"eps = .* is outside"):
        DbscanParams(eps=[0.1, 0.2, value])


@each_params
def test_error_of_an_unknown_name_lists_the_names(kind):
    with pytest.raises(ValueError, match="unknown parameter 'nonsense'") as error:
        with_values(kind(), {"nonsense": 1})
    assert all(name in str(error.value) for name in collect_fields(kind()))


def test_error_of_with_values_names_the_group():
    with pytest.raises(ValueError, match=r"^clustering\.dbscan\.min_samples = 0 is outside"):
        with_values(PipelineParams(), {"clustering.dbscan.min_samples": 0})


def test_node_declares_the_parameters_of_the_pipeline():
    whole = collect_fields(PipelineParams())
    parts = [collect_fields(kind()) for kind in (GroundNodeParams, ClusteringNodeParams, RefinementNodeParams)]
    assert {k: v for part in parts for k, v in part.items()} == whole


def test_parameter_file_may_be_nested_or_dotted(tmp_path):
    nested = config(
        tmp_path,
        """
/**:
  ros__parameters:
    clustering:
      dbscan:
        min_samples: 5
        eps: [0.1, 0.2, 0.3]
    seed: {source: file}
""",
    )
    dotted = config(
        tmp_path,
        """
perception:
  ros__parameters:
    clustering.dbscan.min_samples: 5
    clustering.dbscan.eps: [0.1, 0.2, 0.3]
    seed.source: file
""",
    )
    assert nested == dotted
    assert with_values(PipelineParams(), nested).clustering.dbscan == DbscanParams(eps=(0.1, 0.2, 0.3), min_samples=5)


def test_each_parameter_can_be_set_in_a_file(tmp_path):
    text = "node:\n  ros__parameters:\n" + "".join(
        f"    {name}: {list(value) if isinstance(value, tuple) else repr(value)}\n"
        for name, value in flatten(PlayerParams()).items()
    )
    assert with_values(PlayerParams(), config(tmp_path, text, PlayerParams())) == PlayerParams()


def test_parameters_of_other_nodes_in_a_file_are_ignored(tmp_path):
    values = config(
        tmp_path,
        """
player: {ros__parameters: {rate: 2.0}}
clustering: {ros__parameters: {clustering.dbscan: {min_samples: 7}, use_sim_time: true}}
silent: {ros__parameters: }
""",
    )
    assert values == {"clustering.dbscan.min_samples": 7}


def test_empty_parameter_file_sets_nothing(tmp_path):
    assert config(tmp_path, "# nothing yet\n") == {}


@pytest.mark.parametrize(
    "text, words",
    [
        ("node: [1, 2\n", ("cannot read",)),
        ("\tnode: 1\n", ("cannot read",)),
        ("perception: {dbscan: {eps: 1}}", ("'perception'", "ros__parameters")),
        ("perception: 5", ("'perception'", "ros__parameters")),
        ("perception: {ros__parameters: [1]}", ("'perception'", "ros__parameters")),
        ("- perception\n", ("not a parameter file",)),
        ("perception", ("not a parameter file",)),
    ],
)
def test_error_of_an_invalid_parameter_file_names_it(tmp_path, text, words):
    with pytest.raises(InputError) as error:
        config(tmp_path, text)
    message = str(error.value)
    assert str(tmp_path / "params.yaml") in message and "\n" not in message
    assert all(word in message for word in words)


def test_error_of_an_unreadable_parameter_file_names_it(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00a")
    for name in ("missing.yaml", "binary.yaml", "."):
        with pytest.raises(InputError, match="cannot read the parameter file"):
            read_config(tmp_path / name, PipelineParams())
