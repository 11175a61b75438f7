"""Published values of the STM-CPA paper (Yeom, Kim, Kook, Appl. Sci. 2026, 16(13), 6286).

Rates in percent, distances in metres, times in milliseconds per frame; None where the paper gives
no value. Ranges are named as in scoring/centres/matching.py, stages as in candidates/refine.py.
Tables 3 and 6 are PAPER_TABLE_6 in scoring/centres/tables.py.
"""

from __future__ import annotations

Scores = tuple[float | None, ...]

FRAMES = 1779  # frames with a Pedestrian label among KITTI's 7481 training frames (Section 3.1)
PEDESTRIANS = 4487
TABLE_1 = {"0-15": 2093, "15-30": 1771, "30-45": 468, "45-60": 118, "60+": 37}

# Figure 7 as described in Section 4.2: range of eps with a high recall, and the eps that the paper uses.
FIGURE_7 = {"0-15": ((0.15, 0.20), 0.15), "15-30": ((0.25, 0.35), 0.30), "30-45": ((0.40, 0.50), 0.50)}
MIN_SAMPLES = 10  # "increasing min_samples consistently reduces recall"

# Table 4: range -> stage -> values in the columns of PAPER_TABLE_6. The F1 of `final` is from Section 4.5.
TABLE_4: dict[str, dict[str, Scores]] = {
    "0-15": {"stage1": (76.2, 53.7, 63.0, None, 0.12), "stage2": (73.0, 69.4, 71.2, 95.8, 0.12)},
    "15-30": {
        "stage1": (43.5, 24.2, 31.1, None, 0.18),
        "stage2": (24.7, 48.4, 32.7, 56.8, 0.20),
        "final": (None, None, 35.6, None, None),
    },
    "30-45": {"stage1": (26.1, 6.2, 10.0, None, 0.28), "stage2": (8.5, 22.1, 12.3, 32.8, 0.22)},
    "45-60": {"stage1": (2.5, 4.3, 3.2, None, 0.50), "stage2": (0.8, 4.3, 1.4, 33.3, 0.13)},
    "60+": {"stage1": (0.0, 0.0, 0.0, None, None)},
}

# Table 5: CPA at 15 to 60 m with 0 to 8 steps, in the columns of PAPER_TABLE_6.
TABLE_5 = (
    (44.7, 60.5, 51.4, 80.6, 0.14),
    (46.4, 56.6, 51.0, 83.1, 0.14),
    (46.9, 52.8, 49.7, 85.8, 0.12),
    (47.9, 50.3, 49.1, 86.1, 0.14),
    (48.5, 47.2, 47.9, 86.7, 0.14),
    (48.6, 45.3, 46.9, 86.9, 0.14),
    (49.2, 43.1, 45.9, 87.8, 0.12),
    (49.5, 42.2, 45.6, 88.7, 0.14),
    (49.8, 41.1, 45.1, 88.8, 0.14),
)

# Figure 8, values stated in the text or in Table 4: range -> steps -> recall, precision, F1.
FIGURE_8: dict[str, dict[int, Scores]] = {
    "15-30": {0: (24.7, 48.4, 32.7), 2: (None, None, 35.6)},
    "30-45": {0: (8.5, 22.1, 12.3)},
    "45-60": {0: (0.8, 4.3, 1.4)},
}

# Table 7: recall, precision, F1, centre error of detectors, from another study of KITTI.
TABLE_7: dict[str, Scores] = {
    "PointPillars": (43.0, 66.0, 52.0, None, 0.11),
    "AVOD": (43.0, 57.0, 48.0, None, 0.14),
    "PointCNN": (55.0, 28.0, 37.0, None, 0.12),
    "F-PointNet": (62.0, 22.0, 33.0, None, 0.16),
}

# Table 8: fraction of matches with a 3D IoU of at least 0.10 and 0.25, the same in BEV, and the mean IoU
# in 3D and in BEV.
TABLE_8 = {
    "stage1": (88.4, 76.7, 88.6, 79.7, 0.346, 0.371),
    "stage2": (88.6, 79.0, 89.0, 81.4, 0.354, 0.377),
    "final": (88.9, 79.0, 89.2, 81.6, 0.353, 0.376),
}

# Table 9: preprocessing, DBSCAN, ground snapping, height filter, STM, CPA, total.
TABLE_9 = {
    "no height filter": (6.400, 65.187, 48.529, 0.000, 31.384, 0.000, 151.500),
    "height filter": (6.400, 65.187, 48.529, 0.220, 4.786, 0.000, 125.121),
    "final": (6.400, 65.187, 48.529, 0.220, 5.757, 0.130, 126.223),
}
