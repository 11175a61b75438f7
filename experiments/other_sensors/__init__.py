"""Detection on labelled frames of other sensors, and on KITTI with changed intensity."""
