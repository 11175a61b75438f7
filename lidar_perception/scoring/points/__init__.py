"""Ground, clusters and points against labels."""
