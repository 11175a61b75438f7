"""Simulated streets, campuses and interiors, and spinning LiDARs: labelled scans without a data set."""
