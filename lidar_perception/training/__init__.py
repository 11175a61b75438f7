"""Training: one loop for every network of the package, and what each network brings to it."""
