"""Pedestrian candidates among clusters: paper A (Yeom, Kim, Kook, Appl. Sci. 2026, 16(13), 6286)"""
