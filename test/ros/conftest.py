"""A cloud as a message, for all tests of nodes."""

import pytest


@pytest.fixture(scope="session")
def good_cloud(drive_bag):
    """The first of the simulated drive."""
    from lidar_perception.data.bag import Bag
    from lidar_perception.wire.topics import POINTS
    with Bag(drive_bag) as bag:
        return next(m for _, _, m in bag.messages({POINTS}))
