"""The sensor on its robot: what is cropped, where it is mounted, and how it moves."""
