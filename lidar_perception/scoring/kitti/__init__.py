"""The protocol of KITTI's object benchmark."""
