"""Experiments over the frames of a recording: measuring, statistics, and the report."""
