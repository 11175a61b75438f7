"""Framework for experiments over the frames of a recording: measurement, statistics, report."""
