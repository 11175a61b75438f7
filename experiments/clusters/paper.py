"""Published values of paper C (Zhang, Xi, Fang, Wang, PLOS One 2026, e0348581).

Fractions in percent, times in milliseconds per frame, on unknown hardware. The text that we have
lacks the tables, so these are only the values stated in Sections 3.1 and 3.2. The data sets are
named as in DATA_SETS.
"""

from __future__ import annotations

Values = tuple[float | None, ...]

DATA_SETS = ("KITTI", "nuScenes")

# Figure 6 (after 240 "iterations"), Figure 8 and Table 3: accuracy, precision, recall, F1, IoU, ms.
# For EC and FCC the differences in precision and IoU in the text fit neither table, so only their
# accuracy and time are listed.
SEGMENTATION: dict[str, dict[str, Values]] = {
    "KITTI": {
        "ours": (94.96, 94.3, 93.5, 93.9, 92.12, 15.63),
        "EC": (81.76, None, None, None, None, 22.52),
        "FCC": (85.23, None, None, None, None, 98.36),
        "MaskPLS": (88.39, None, None, None, None, 12.34),
        "RTPCC-RL": (91.26, None, None, None, None, 120.56),
    },
    "nuScenes": {
        "ours": (93.12, 92.8, 91.4, 92.1, 90.89, 17.24),
        "EC": (79.27, None, None, None, None, 25.84),
        "FCC": (82.86, None, None, None, None, 135.72),
        "MaskPLS": (86.37, None, None, None, None, 14.85),
        "RTPCC-RL": (89.12, None, None, None, None, 147.92),
    },
}

# Table 2: best parameters. The text omits the other rows.
BEST = {"alpha": 1.2, "beta": 0.5, "gamma": 0.8}

# Detection: mAP in percent, protocol not stated. Of the training times in Table 5, the text states only
# that of the full network.
TABLE_4 = {"KITTI": (90.36, 81.07), "nuScenes": (89.03, 80.15)}  # mAP and NDS with radii of 0.1, 0.2 and 0.4 m
TABLE_5 = {
    "KITTI": {
        "base": 75.52,
        "dynamic-threshold": 80.15,
        "log-point-count": 81.33,
        "skip": 83.44,
        "msg-mrg": 85.10,
        "msg-skip": 86.33,
        "mrg-skip": 86.89,
        "improved": 88.96,
    },
    "nuScenes": {
        "base": 73.81,
        "dynamic-threshold": 78.40,
        "log-point-count": 79.88,
        "skip": 81.28,
        "msg-mrg": 82.95,
        "msg-skip": 84.12,
        "mrg-skip": 84.67,
        "improved": 86.27,
    },
}
MINUTES = {"KITTI": {"improved": 12.32}, "nuScenes": {"improved": 12.81}}
TABLE_6 = {"improved": (94.36, 91.24, 87.52, 91.04)}  # KITTI: easy, moderate, hard, mean
# Figure 10, KITTI: network -> class -> AP at the difficulties easy, moderate and hard
FIGURE_10: dict[str, dict[str, Values]] = {
    "improved": {"Car": (97.21, None, 90.89), "Pedestrian": (89.24, None, 76.61), "Cyclist": (None, None, 79.06)},
    "pointnet": {"Car": (88.92, None, 76.35), "Pedestrian": (75.68, None, 62.13), "Cyclist": (None, None, 65.13)},
}
TABLE_7 = {"map": 92.68, "ate": 0.298, "ase": 0.218, "nds": 83.45}  # `improved` network on nuScenes
# Table 8: data set -> network -> change -> mAP
TABLE_8: dict[str, dict[str, dict[str, float]]] = {
    "KITTI": {"improved": {"10 %": 84.37, "50 %": 91.85}, "pointnet": {"10 %": 68.21}},
    "nuScenes": {"improved": {"10 %": 82.15, "50 %": 90.03}},
}
