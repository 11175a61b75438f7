"""Fixtures for tests of bags."""

from __future__ import annotations

import warnings

import pytest
from bag_samples import message_bytes

from lidar_perception.types import InputWarning


@pytest.fixture
def no_warning():
    """Turn warnings into errors, except in tests that expect one."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        yield


@pytest.fixture(scope="module")
def messages(sample_bag):
    return message_bytes(sample_bag)
