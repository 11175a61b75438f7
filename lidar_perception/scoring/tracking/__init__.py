"""Tracking scores: HOTA, CLEAR MOT and AB3DMOT's averages over recall."""
