"""Departures from the three papers, and the command that measures each of their tables.

docs/generate.py writes both into docs/explanation/papers.md.
"""

from __future__ import annotations

from typing import NamedTuple


class Departure(NamedTuple):
    """A place where this package departs from a paper, or where the text of the paper is ambiguous.

    Attributes:
        place: Letter of the paper, and section, equation, table or figure.
        paper: What the paper says.
        package: What this package does.
        option: Setting that follows the paper; empty if there is none.
    """

    place: str
    paper: str
    package: str
    option: str = ""


class MeasuredTable(NamedTuple):
    """A table or figure of a paper, the command that measures it, and the data that the command needs."""

    place: str
    content: str
    command: str
    data: str


DEPARTURES = (
    Departure(
        "A 3.2",
        "points below z = -1.3 m are ground; a RANSAC plane serves to snap boxes",
        "points near the plane are ground, which holds on slopes",
        "`ground.threshold.separate: height`, as in the configuration `paper`",
    ),
    Departure(
        "A 3.3",
        "range bands are clustered separately",
        "the same by default; `best` joins clusters across the borders",
        "`clustering.dbscan.join_bands: false`",
    ),
    Departure(
        "A Table 2",
        'window 80 x 32, "fixed"',
        "two readings: each cluster is stretched to the window (default), or the window has a size in metres (`best`)",
        "`stm.window: stretched` or `stm.window: metric`",
    ),
    Departure("A 3.5", "PCA alignment", "rotation about z only, so that z stays up", "`stm.axis: pca`"),
    Departure(
        "B 3",
        "at most 32 points per pillar",
        "no limit, as 32 would drop 2 % of KITTI's points",
        "`max_points=32` in `make_config`",
    ),
    Departure(
        "B 3",
        "x and y enter the network in metres",
        "times 0.02, as a compact network would spend its channels on the position",
        "`xy_scale=1.0` in `make_config`",
    ),
    Departure(
        "B 3.1.1",
        "circled plus in the neck, number of channels C not given",
        "element-wise addition, C = 32",
        "`fusion='concat'` in `make_config`",
    ),
    Departure(
        "B 3.1.2",
        "DBSCAN without parameters",
        "eps 0.5, 0.7 and 1.0 m by range, `min_samples` 5; they keep a car in one cluster",
        "`clustering.dbscan.eps` and `clustering.dbscan.min_samples`",
    ),
    Departure(
        "B 3.1.2", "a fitted ellipse around each cluster, way of fitting not given", "from the covariance of its points"
    ),
    Departure(
        "B 3.1.2",
        "number and widths of the layers of the Cluster Map Feature Net not given",
        "three layers of 16, 32 and 64 channels",
        "`map_channels` in `make_config`",
    ),
    Departure(
        "B Table 2",
        "limits of diagonals with gaps between classes, 1.71 to 1.72 m and 2.99 to 3.00 m",
        "no gaps: a class begins at its lower limit and ends at the next",
    ),
    Departure(
        "B Table 2", "diagonal of a cluster's bounding box, orientation not given", "the rectangle of least area"
    ),
    Departure(
        "B 3.2.2",
        "the cluster id is the fifth input",
        "the id times 0.01, so that it is as large as the others",
        "`id_scale=1.0` in `make_config`",
    ),
    Departure(
        "B 4.1",
        "loss, optimizer and augmentation not given",
        "losses of Lang et al., but the focal loss of each class is divided by its own "
        "matched anchors, as a car has ten times as many as a pedestrian; AdamW with one "
        "cycle",
    ),
    Departure(
        "B 4.1",
        "300 epochs on KITTI, validation every 5, best weights kept; measured on KITTI's test set",
        "`reproduce eg-pointpillars` does the same with KITTI and no `--budget`, but "
        "measures a tenth of the labelled frames, as the test labels are not public. The "
        "shipped weights are trained on simulated streets",
        "`--split` names other frames to measure on",
    ),
    Departure("B 4.3", "mean over nine cells without the number of recall points", "R40, as KITTI since 2019"),
    Departure(
        "C Eq. 9",
        "gamma 0.8",
        "the detector uses 0, as 0.8 joins cars that stand side by side and halves mAP on KITTI",
        "`clustering.euclidean.gamma: 0.8`",
    ),
    Departure(
        "C Eqs. 15, 17",
        "farthest point sampling for centroids",
        "the first 32 of a random sample",
        "`train pointnet --network farthest`",
    ),
    Departure(
        "C Eq. 17",
        "weights by local density",
        "points per metre of radius, at most as many as neighbours are searched, so that "
        "weights are constant in dense clusters; the option counts all points in the ball "
        "per volume",
        "`train pointnet --network ball-density`",
    ),
    Departure("C Eq. 1", "robustness measure", "not part of the detector; measured by `reproduce clusters`"),
    Departure(
        "C Eq. 10",
        'regularised objective that the clustering "minimises"',
        "not implemented; no step of the paper's method uses it",
    ),
    Departure(
        "C introduction",
        "curvature-consistent region growing: named, never specified",
        "off by default; our reading: clusters grow only from points whose surface "
        "variation is near the mean around them",
        "`clustering.euclidean.curvature`",
    ),
    Departure(
        "C introduction", "attention-based encoding, bidirectional pyramid: named, never specified", "not implemented"
    ),
    Departure("C 4", '"accuracy" of detection, way of counting unknown', "KITTI AP and nuScenes metrics"),
    Departure(
        "C 4",
        "15.6 ms for the segmentation, 34 frames per second",
        "slower, see [performance](performance.md); reports name the machine",
    ),
)

KITTI, SIM = "KITTI object", "KITTI object, or `sim`"
STM_CPA = "./lidar reproduce stm-cpa DATA --out DIR"
EG = "./lidar reproduce eg-pointpillars DATA --out DIR"
CLUSTERS = "./lidar reproduce clusters DATA --out DIR"
MEASURED = (
    MeasuredTable("A Table 1, 3 to 6, 8, 9", "pedestrians, stages, ranges, CPA steps, overlap, time", STM_CPA, KITTI),
    MeasuredTable("A Figures 7, 8", "search of eps and `min_samples`, CPA by range", STM_CPA, KITTI),
    MeasuredTable("A Table 7", "PointPillars V0 by centre distance on the same frames", STM_CPA, KITTI),
    MeasuredTable("A Table 2, Section 3.5", "readings of window and PCA alignment", STM_CPA, KITTI),
    MeasuredTable("B Table 2, Figure 13", "diagonals of boxes and clusters by class", EG, SIM),
    MeasuredTable("B Table 5", "V0 to V4: AP of three classes and their mean", EG, SIM),
    MeasuredTable("B Table 6", "gain, time, overhead, parameters", EG, SIM),
    MeasuredTable("B Figure 20", "V0 and V4 side by side", EG, SIM),
    MeasuredTable(
        "B Tables 2, 5, 6, Figures 13, 20",
        "with the shipped weights, without training",
        EG.replace("rs ", "rs-shipped "),
        KITTI,
    ),
    MeasuredTable("B Sections 1, 5", "V0 and V4 with 10, 25, 50 and 100 % of the labels", EG, SIM),
    MeasuredTable(
        "C Tables 2, 3, Figures 6, 8",
        "parameters; segmentation against other clusterings",
        CLUSTERS.replace("clusters", "clusters-segmentation"),
        "KITTI, nuScenes, or `sim`",
    ),
    MeasuredTable(
        "C Tables 2 to 6, 8, Figures 6, 8, 10",
        "all of these; radii, ablation, difficulties, fewer points and noise",
        CLUSTERS,
        "KITTI, nuScenes, or `sim`",
    ),
    MeasuredTable(
        "C Tables 6 to 8, Figure 10, gamma",
        "the same with the shipped weights of PointNet and PointPillars V0, without training",
        CLUSTERS.replace("clusters", "clusters-shipped"),
        "KITTI, nuScenes, or `sim`",
    ),
    MeasuredTable(
        "C Table 7", "scores of nuScenes with velocities of the tracker", CLUSTERS, "nuScenes, or simulated drives"
    ),
)
