"""lidar_studio: label drives, and view recordings and running nodes, in the browser."""
