"""pytest plugin to test stacks that use this package, with bags, running nodes and assertions.

    pytest_plugins = ["lidar_perception.testing"]           # in conftest.py

    def test_pedestrian_is_detected(peer, processes, make_bag):
        processes.start_graph(["pointpillars"])             # or start(node), or run(your program)
        detections = peer.listen("/pointpillars_detector/output/detections", MARKERS)
        processes.play(make_bag([cloud], [[("Pedestrian", box)]]))
        peer.wait(lambda: detections, "detections")
        assert_detections(detections[-1], [("Pedestrian", box)])

Fixtures: `peer`, a node in the test process; `processes`, whose logs are shown when a test fails;
`shared_peer` and `shared_processes`, for all tests of a module; `domain`, a private ROS domain;
`make_bag` and `drive_bag`. Functions: `detections.assert_detections`, `bags.make_frames`, and
`launching` for launch_testing. docs/how-to/test-your-stack.md has a complete test.

The plugin has no entry point, so pytest loads it only if a conftest.py names it. It needs pytest
and the standard library; fixtures import ROS when they need it.
"""

from lidar_perception.testing.fixtures import (
    domain,
    drive_bag,
    make_bag,
    peer,
    processes,
    pytest_runtest_makereport,
    shared_peer,
    shared_processes,
)

__all__ = [
    "domain",
    "drive_bag",
    "make_bag",
    "peer",
    "processes",
    "pytest_runtest_makereport",
    "shared_peer",
    "shared_processes",
]
