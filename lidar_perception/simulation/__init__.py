"""A seeded street and a spinning LiDAR: labelled scans without a data set."""
