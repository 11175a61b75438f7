"""A few cases of each part of the fuzzer, and the fuzzer itself."""

from __future__ import annotations

import subprocess
import sys
from mmap import mmap
from pathlib import Path

import numpy as np
import pointnet_samples
import pytest

pytest.importorskip("rclpy", reason="needs ROS 2, or the extra [ros]")

from detection_samples import make_random_network, make_tiny_config

from fuzz import files, messages, mutation, parameters
from fuzz.case import FAILED, REFUSED, SURVIVED, Case, Outcome, read_memory_mb, run_cases
from fuzz.command import judge_command
from fuzz.nodes import INPUTS, FedNode
from fuzz.valid_messages import CLOUD, make_cloud, make_valid_message, mutate_valid_message
from lidar_perception.detectors.checkpoint import Header, save_checkpoint
from lidar_perception.nodes import NODES
from lidar_perception.nodes.external_node import create_context, shut_down_context
from lidar_perception.wire.codec import encode, make_bag_message
from msg_utils.point_cloud2 import add_columns, to_array

COLUMNS = ("ground", "in_view", "cluster_id", "intensity")
LARGEST = {kind: np.iinfo(kind).max for kind in ("u1", "i2", "u4", "i4")} | {"f4": 3e38, "f8": 1e308}
WITH_CLOUDS = [name for name, (_, inputs, _) in INPUTS.items() if "input/points" in inputs]


@pytest.fixture(scope="module")
def nodes(domain, tmp_path_factory):
    """Return every node by its name, with small networks."""
    context, folder = create_context(domain), tmp_path_factory.mktemp("weights")
    pillars, clusters = str(folder / "v4.safetensors"), str(folder / "pointnet.safetensors")
    config = make_tiny_config("v4", low=(0.0, -10.24, -3.0), high=(20.48, 10.24, 1.0))
    save_checkpoint(pillars, make_random_network(config), Header(config))
    config = pointnet_samples.make_small_config()
    save_checkpoint(clusters, pointnet_samples.make_random_network(config), Header(config))
    values = {
        "pointpillars_detector": {"pointpillars.weights": pillars},
        "pointnet_detector": {"pointnet.weights": clusters},
        "fused_detector": {"fused.weights": pillars, "fused.classifier": clusters},
    }
    nodes_by_name = {name: FedNode(name, context, **values.get(name, {})) for name in INPUTS}
    yield nodes_by_name
    shut_down_context(context, *(each.node for each in nodes_by_name.values()))


def test_every_input_of_a_node_is_fuzzed(nodes):
    assert set(INPUTS) == set(NODES) - {"bag_player", "bag_recorder"}
    for name, (_, inputs, _) in INPUTS.items():
        assert set(inputs) == {
            topic
            for topic in nodes[name].calls
            if "parameter" not in topic and topic not in ("clock", "tf", "tf_static")
        }


@pytest.mark.no_cover
@pytest.mark.parametrize("part, cases", [(messages, 150), (parameters, 150)])
def test_nodes_process_or_reject_each_case(part, cases, nodes, tmp_path):
    attempt = part.Attempt(tmp_path, nodes)
    outcomes = [outcome for _, _, outcome, _ in run_cases(part.make_case, attempt, 1, range(cases), 500.0, np.inf)]
    assert [outcome for outcome in outcomes if outcome.verdict == FAILED] == []
    assert len(outcomes) == cases
    assert min(sum(o.verdict == v for o in outcomes) for v in (SURVIVED, REFUSED)) >= cases // 10


@pytest.mark.no_cover
def test_commands_process_or_reject_damaged_files():
    done = subprocess.run(
        [sys.executable, "-m", "fuzz", "files", "--cases", "16"],
        text=True,
        capture_output=True,
        cwd=Path(__file__).parents[1],
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 failed" in done.stdout


def test_node_warns_about_curves_of_other_weights(nodes):
    fused = nodes["fused_detector"].node
    assert "not fitted to" in fused.diagnostics.counts["doubt"] == fused.detector.warning


@pytest.mark.no_cover
@pytest.mark.parametrize("name", WITH_CLOUDS)
def test_extreme_columns_allocate_no_memory(nodes, name):
    plain, node, params = make_cloud("columns"), nodes[name], INPUTS[name][2][0]
    turn = np.arange(len(to_array(plain))) % 7
    assert node.attempt("input/points", encode(plain), params, False).reason == ""
    for column in COLUMNS:
        for kind, largest in LARGEST.items():
            least, odd = -largest if kind[0] in "if" else 0, np.nan if kind[0] == "f" else 2
            for values in (np.where(turn < 7, largest, 0), np.choose(turn, [1, largest, least, odd, largest, 0, 1])):
                data = encode(add_columns(plain, make_bag_message, **{column: values.astype(kind)}))
                before = read_memory_mb("VmRSS", reset=True)
                outcome = node.attempt("input/points", data, params, False)
                case = column, kind, values[:7].tolist(), outcome.reason
                assert outcome.verdict != FAILED, case
                assert read_memory_mb("VmHWM") - before < 64, case  # a byte per id would take 2048 MB
    assert node.attempt("input/points", data, params, True).verdict != FAILED


@pytest.mark.parametrize(
    "column, reading",
    [
        ("ground", {"clustering"}),
        ("in_view", set(WITH_CLOUDS)),
        ("cluster_id", {"candidate_refinement", "pointnet_detector"}),
    ],
)
def test_column_with_count_above_1_is_rejected(nodes, column, reading):
    plain = make_cloud("columns")
    plain.fields = [f for f in plain.fields if f.name in ("x", "y", "z", column)]
    plain.fields[-1].offset, plain.fields[-1].datatype, plain.fields[-1].count = 12, 2, 2  # uint8
    for name in WITH_CLOUDS:
        outcome = nodes[name].attempt("input/points", encode(plain), INPUTS[name][2][0], False)
        assert outcome.verdict != FAILED, (name, outcome)
        if name in reading:
            assert outcome.verdict == REFUSED and "count > 1" in outcome.reason, (name, outcome)


def test_cases_depend_on_the_seed_only(monkeypatch):
    samples = {f"{name}/a.bin": bytes(99) for name in files.COMMANDS}
    monkeypatch.setattr(files, "load_samples", lambda: samples)
    for part in (messages, files, parameters):
        first, second, other = ([part.make_case(seed, i) for i in range(30)] for seed in (5, 5, 6))
        assert first == second != other


@pytest.mark.parametrize("seed", range(20))
def test_mutation_changes_a_copy(seed):
    data, rng = make_valid_message(CLOUD), np.random.default_rng(seed)
    assert mutation.mutate_bytes(data, rng)[1] and data == make_valid_message(CLOUD)
    assert mutation.mutate_text("a: 1\nb: [2.5, x]\n", rng)[1]
    assert mutate_valid_message(CLOUD, rng)[0] != data == make_valid_message(CLOUD)


def test_command_passes_with_a_result_or_a_reason():
    assert judge_command(0, "", "").verdict == SURVIVED
    assert judge_command(2, "", "3 frames\nError: cannot read it\n").verdict == REFUSED
    assert judge_command(1, "left out: a frame\n", "").verdict == REFUSED
    traceback = "Traceback (most recent call last):\n\nError: x"
    bad = [
        judge_command(code, "", errors)
        for code, errors in (*((code, "") for code in (None, -11, 1, 2, 70)), (0, traceback), (2, traceback))
    ]
    assert {outcome.verdict for outcome in bad} == {FAILED}


def test_exceptions_and_memory_growth_are_failures():
    def attempt(case):
        if case.name == "1":
            raise ValueError("planted")
        with mmap(-1, (60 if case.name == "2" else 1) * 2**20) as memory:  # new pages, unlike those of malloc
            memory.write(bytes(len(memory)))
        return Outcome(SURVIVED)

    first, second, third = (
        outcome for *_, outcome, _ in run_cases(lambda seed, i: Case(str(i)), attempt, 1, range(3), 40.0, np.inf)
    )
    assert first.verdict == SURVIVED and "planted" in second.reason and "MB" in third.reason
