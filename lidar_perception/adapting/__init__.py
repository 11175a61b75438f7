"""Self-training: what the detectors agree on in drives without labels, and what is learned."""
