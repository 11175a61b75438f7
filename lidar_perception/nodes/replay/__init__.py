"""Nodes that play, record and score bags, and the replay of a bag through a graph of nodes."""
