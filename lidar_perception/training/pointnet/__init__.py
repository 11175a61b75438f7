"""Training of PointNet on clusters."""
