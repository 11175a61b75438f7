"""Measurements from clouds: pure functions on arrays."""
