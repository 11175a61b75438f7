"""Comparison of all detectors on the same frames."""
