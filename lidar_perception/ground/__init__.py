"""Ground segmentation: a frame to an (N,) bool mask, True = ground."""
