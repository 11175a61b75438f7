"""Experiments of the EG-PointPillars paper (Ahn, Kim, Park, CMC 2026, 87(1), 84)."""
