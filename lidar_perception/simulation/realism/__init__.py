"""Simulated against real scans."""
