"""Experiments over KITTI frames: the tables of paper A, and the questions that it leaves open."""
