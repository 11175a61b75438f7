"""Ground segmentation: a cloud to an (N,) bool mask, True = ground."""
