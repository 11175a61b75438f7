"""Scores of ground, clusters and point classes."""
