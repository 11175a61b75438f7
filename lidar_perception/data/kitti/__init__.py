"""KITTI: the object, tracking and raw layouts, read and written."""
