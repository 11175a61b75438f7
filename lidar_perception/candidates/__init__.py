"""Paper A: clusters to pedestrian candidates (Yeom, Kim, Kook, Appl. Sci. 2026, 16(13), 6286)."""
