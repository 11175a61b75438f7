"""Pedestrian candidates from clusters: paper A (Yeom, Kim, Kook, Appl. Sci. 2026, 16(13), 6286)."""
