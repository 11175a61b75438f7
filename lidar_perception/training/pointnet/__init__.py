"""Training of the PointNet on clusters."""
