"""What the cluster network is trained with."""
