"""Experiments on the package, run from a checkout; they are not part of the wheel."""
