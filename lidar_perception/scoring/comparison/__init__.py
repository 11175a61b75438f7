"""Every detector on the same frames, side by side."""
