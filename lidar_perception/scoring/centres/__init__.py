"""Paper A's protocol: pedestrians by centre distance."""
