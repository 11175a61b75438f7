"""Published values of the EG-PointPillars paper (Ahn, Kim, Park, CMC 2026, 87(1), 84).

Average precision in percent, times in milliseconds on one of four RTX 4090 GPUs.
"""

from __future__ import annotations

# Table 5: Car at IoU 0.7, Cyclist and Pedestrian at IoU 0.5; easy, moderate and hard for each.
TABLE_5 = {
    "v0": {"Car": (84.00, 72.89, 68.24), "Cyclist": (80.57, 61.96, 58.32), "Pedestrian": (52.66, 47.09, 43.21)},
    "v1": {"Car": (86.94, 76.06, 68.77), "Cyclist": (79.53, 61.85, 58.18), "Pedestrian": (56.12, 50.96, 46.56)},
    "v2": {"Car": (86.16, 76.01, 68.69), "Cyclist": (82.79, 65.31, 62.01), "Pedestrian": (55.68, 50.05, 44.68)},
    "v3": {"Car": (84.23, 74.82, 68.13), "Cyclist": (81.37, 64.81, 61.37), "Pedestrian": (55.60, 50.81, 45.47)},
    "v4": {"Car": (86.69, 76.44, 74.93), "Cyclist": (81.21, 66.74, 61.91), "Pedestrian": (56.73, 52.31, 46.92)},
}
MAP = {"v0": 63.21, "v1": 65.00, "v2": 65.71, "v3": 65.18, "v4": 67.09}
MS = {"v0": 13.1, "v1": 13.9, "v2": 24.4, "v3": 32.5, "v4": 46.4}

# Table 6. V4's overhead contradicts Table 5, which gives 33.3 ms.
IMPROVEMENT = {"v1": 1.79, "v2": 2.50, "v3": 1.97, "v4": 3.88}
OVERHEAD_MS = {"v1": 0.8, "v2": 11.3, "v3": 19.4, "v4": 11.3}

# Table 2: limits of the BEV diagonal of a cluster's box, in metres.
TABLE_2 = {"Car": (3.00, 6.40), "Cyclist": (1.72, 2.99), "Pedestrian": (0.40, 1.71)}

EPOCHS, VALIDATION_EPOCHS = 300, 5  # from Section 4.1
