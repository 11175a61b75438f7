"""KITTI's object, tracking, odometry and raw layouts, and KITTI-360."""
