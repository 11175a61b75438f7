"""Reception in simulated time: silent and slow sensors, and late poses."""

from __future__ import annotations

from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest

from lidar_perception.nodes import reception as reception_module
from lidar_perception.nodes.reception import Reception
from lidar_perception.nodes.track_outputs import find_marker_lifetime_ns
from lidar_perception.params import MarkerParams, ReceptionParams


@pytest.mark.parametrize(
    "topic, what, publisher, silent, slow",
    [
        ("/velodyne_points", "cloud", "driver", "is the sensor /driver connected and running", "is the sensor /dri"),
        ("/velodyne_points", "cloud", "", "is the sensor connected and running?", "sensor overloaded"),
        ("/points", "cloud", "rosbag2_player", "is the player /rosbag2_player paused", "lower rate"),
        (
            "/clustering/output/points",
            "cloud",
            "clustering",
            "is the node /clustering running",
            "is the node /clustering overloaded",
        ),
        (
            "/fused_detector/output/detections",
            "array",
            "fused_detector",
            "is the detector /fused_detector running and receiving clouds?",
            "is the detector /fused",
        ),
        ("/boxes", "array", "", "is the detector running", "is the detector overloaded"),
    ],
)
def test_reception_hint_depends_on_publisher(monkeypatch, topic, what, publisher, silent, slow):
    simulated = SimulatedReception(monkeypatch, lambda stamp: 0.0, rate=10.0)
    simulated.reception.topic, simulated.reception.what = topic, what
    simulated.reception.last_publishers = [SimpleNamespace(node_namespace="/", node_name=publisher)] * bool(publisher)
    simulated.reception.last_time, simulated.now = 1.0, 4.0
    (message,) = (text for _, _, text in simulated.reception.problems())
    assert message.startswith(f"no {what} on {topic} for more than 2 s: ") and silent in message
    simulated.now = 1.0
    monkeypatch.setattr(simulated.reception.arrivals, "measure_rate", lambda: 3.0)
    (message,) = (text for _, _, text in simulated.reception.problems())
    assert slow in message and ("sensor" in message) == (topic == "/velodyne_points")


class SimulatedReception:
    """Reception of clouds at 10 Hz in simulated time with poses that arrive lag(stamp) seconds later. answered:
    (stamp, True if the cloud had its pose) of each delivered cloud.
    """

    def __init__(self, monkeypatch, lag, **params):
        self.now, self.lag, self.answered = 0.0, lag, []
        monkeypatch.setattr(reception_module, "monotonic", lambda: self.now)
        node = SimpleNamespace(
            resolve_topic_name=lambda name: name,
            _parameter_overrides={},
            create_guard_condition=lambda work: SimpleNamespace(trigger=lambda: self.todo.append(work)),
        )
        self.todo, reception_params = [], ReceptionParams(**params)
        self.reception = Reception(node, None, "points", self.deliver, lambda: reception_params)
        handle = MagicMock()
        handle.take_message.return_value = None
        self.reception.subscription = MagicMock(handle=handle)
        self.reception.list_publishers = lambda: []

    def deliver(self, stamp, patient):
        known = self.now >= stamp + self.lag(stamp)
        if known or not patient:
            self.answered.append((stamp, known))
        return None if known else "its pose"

    def run(self, seconds):
        for tick in range(1, round(seconds * 100)):
            self.now = tick / 100
            if tick % 10 == 0:
                self.reception._on_message(
                    self.now, {"publication_sequence_number": tick // 10, "source_timestamp": tick * 10**7}
                )
            self.reception.retry()
            while self.todo:
                self.todo.pop(0)()


@pytest.mark.parametrize(
    "given, learned, error, stale, lifetime",
    [
        (0.0, None, 2, 10, 2),
        (10.0, None, 2, 10, 2),
        (0.4, None, 7.5, 15, 6.25),
        (0.0, 0.4, 7.5, 15, 6.25),
        (10.0, 0.4, 2, 10, 2),
    ],
)
def test_slow_sensor_is_not_reported_as_silent(monkeypatch, given, learned, error, stale, lifetime):
    simulated = SimulatedReception(monkeypatch, lambda stamp: 0.0, rate=given)
    simulated.reception.arrivals.expected_rate, simulated.reception.last_time = learned, 1.0
    for simulated.now, kinds in (
        (1 + error, []),
        (1.1 + error, ["silent"]),
        (1 + stale, ["silent"]),
        (1.1 + stale, ["stale"]),
    ):
        assert [kind for kind, _, _ in simulated.reception.problems()] == kinds
    for setting, seconds in ((0, 0), (2, lifetime), (9, 9)):
        node = SimpleNamespace(
            inputs=SimpleNamespace(receptions=[simulated.reception]),
            node_params=SimpleNamespace(output=MarkerParams(marker_lifetime=setting)),
        )
        assert find_marker_lifetime_ns(node) == seconds * 10**9


@pytest.mark.parametrize("lag, rate", [(0.0, 10), (0.05, 10), (0.13, 10), (0.25, 4), (0.6, 1.6)])
def test_clouds_get_their_own_late_poses(monkeypatch, lag, rate):
    simulated = SimulatedReception(monkeypatch, lambda stamp: lag)
    simulated.run(30.0)
    assert all(known for _, known in simulated.answered)
    stamps = [stamp for stamp, _ in simulated.answered]
    assert stamps == sorted(stamps) and len(stamps) > 0.9 * 30 * rate


def test_clouds_without_poses_are_used_until_poses_return(monkeypatch):
    simulated = SimulatedReception(monkeypatch, lambda stamp: 100.0 if 5 < stamp < 40 else 0.15, max_wait=2.0)
    simulated.run(60.0)
    assert not [s for s, _ in simulated.answered if 5.2 < s < 6.0]  # it waits for max_wait
    without = [s for s, known in simulated.answered if 8 < s < 39]
    assert len(without) > 0.85 * 310 and not any(k for s, k in simulated.answered if 8 < s < 39)
    assert all(known for s, known in simulated.answered if s > 46)
