"""The experiment of the EG-PointPillars paper: its tables, and the study of labels."""

from __future__ import annotations

from experiments.eg_pointpillars.measure import measure_frame
from experiments.eg_pointpillars.models import PROTOCOL, TRAINING, choose_models
from experiments.eg_pointpillars.pictures import make_picture_sections
from experiments.eg_pointpillars.tables import make_sections
from experiments.framework.experiment import Experiment
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.param_fields import flatten

EG_POINTPILLARS = Experiment(
    "eg-pointpillars",
    "EG-PointPillars: the tables of the paper",
    "Do ground segmentation and clusters as inputs help PointPillars, and do they save labels?",
    measure_frame,
    make_sections,
    {"ground": flatten(EXPERT_GROUND), "clustering": flatten(EXPERT_CLUSTERING)},
    training=TRAINING,
    protocol=PROTOCOL,
    models=choose_models,
    illustrate=make_picture_sections,
)
