"""Our algorithms timed beside others in one run: python -m benchmark, or ./lidar benchmark."""
