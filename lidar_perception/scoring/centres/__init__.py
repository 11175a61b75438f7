"""Protocol of paper A: pedestrians matched by centre distance."""
