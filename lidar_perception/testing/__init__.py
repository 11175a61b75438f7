"""For tests of stacks that use this package: bags, running nodes, waiting, and what was detected.

    pytest_plugins = ["lidar_perception.testing"]           # in conftest.py

    def test_a_pedestrian_is_found(peer, processes, make_bag):
        processes.start_graph(["pointpillars"])             # or start(node), or run(your program)
        found = peer.listen("/pointpillars_detector/output/detections", MARKERS)
        processes.play(make_bag([cloud], [[("Pedestrian", box)]]))
        peer.wait(lambda: found, "detections")
        assert_detections(found[-1], [("Pedestrian", box)])

Fixtures: `peer`, a node of the test's own; `processes`, whose logs are shown when a test fails;
`shared_peer` and `shared_processes`, for all tests of a module; `domain`, a ROS domain that nobody
else uses; `make_bag` and `drive_bag`. Functions: `detections.assert_detections`, `bags.recording`,
and `launching` for launch_testing. docs/how-to/test-your-stack.md has a whole test.

There is no entry point: whoever does not name this plugin does not load it. To load it takes pytest
and the standard library; ROS is imported by the fixtures that need it.
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

__all__ = ["domain", "drive_bag", "make_bag", "peer", "processes", "pytest_runtest_makereport",
           "shared_peer", "shared_processes"]
