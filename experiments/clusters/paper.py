"""Published values of paper C (Zhang, Xi, Fang, Wang, PLOS One 2026, e0348581).

Shares in percent, times in milliseconds per frame, on unknown hardware. The tables of the paper
are pictures that its text lacks; these are the values that the text of Sections 3.1 and 3.2 states.
The data sets are named as in DATA_SETS.
"""

from __future__ import annotations

Values = tuple[float | None, ...]

DATA_SETS = ("KITTI", "nuScenes")

# Figures 6 (after 240 "iterations") and 8, and Table 3: accuracy, precision, recall, F1, IoU, ms.
# For EC and FCC the text has differences of precision and IoU that fit neither table, so only their
# accuracy and time are listed.
SEGMENTATION: dict[str, dict[str, Values]] = {
    "KITTI": {"ours": (94.96, 94.3, 93.5, 93.9, 92.12, 15.63),
              "EC": (81.76, None, None, None, None, 22.52),
              "FCC": (85.23, None, None, None, None, 98.36),
              "MaskPLS": (88.39, None, None, None, None, 12.34),
              "RTPCC-RL": (91.26, None, None, None, None, 120.56)},
    "nuScenes": {"ours": (93.12, 92.8, 91.4, 92.1, 90.89, 17.24),
                 "EC": (79.27, None, None, None, None, 25.84),
                 "FCC": (82.86, None, None, None, None, 135.72),
                 "MaskPLS": (86.37, None, None, None, None, 14.85),
                 "RTPCC-RL": (89.12, None, None, None, None, 147.92)}}

# Table 2: the best values and their IoU and time; the other rows are not in the text.
BEST = {"alpha": 1.2, "beta": 0.5, "gamma": 0.8}
