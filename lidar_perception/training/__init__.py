"""Training: one loop for every network of the package, and a trainer for each network."""
