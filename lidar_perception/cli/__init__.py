"""The lidar-perception command."""
