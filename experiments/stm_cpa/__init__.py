"""The experiment of the STM-CPA paper (paper A)."""
