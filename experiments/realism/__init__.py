"""Comparison of simulated with real scans."""
