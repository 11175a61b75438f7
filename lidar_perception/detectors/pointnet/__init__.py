"""Paper C's detector: clusters of a cloud, classified and boxed by an improved PointNet."""
