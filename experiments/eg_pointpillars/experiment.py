"""Experiments of the EG-PointPillars paper: with networks that are trained for it, and with the shipped weights."""

from __future__ import annotations

from dataclasses import replace
from hashlib import sha256

from experiments.eg_pointpillars.measure import measure_frame
from experiments.eg_pointpillars.models import PROTOCOL, TRAINING, choose_models, read_shipped_models
from experiments.eg_pointpillars.pictures import make_picture_sections
from experiments.eg_pointpillars.tables import make_sections, make_shipped_sections
from experiments.framework.experiment import Experiment
from lidar_perception.detectors.params import MIN_SCORE
from lidar_perception.detectors.pointpillars.params import EXPERT_CLUSTERING, EXPERT_GROUND
from lidar_perception.param_fields import flatten

SHIPPED_MODELS = read_shipped_models()
EG_POINTPILLARS = Experiment(
    "eg-pointpillars",
    "EG-PointPillars: the tables of the paper",
    "Do ground segmentation and clusters as inputs help PointPillars, and do they save labels?",
    measure_frame,
    make_sections,
    {"ground": flatten(EXPERT_GROUND), "clustering": flatten(EXPERT_CLUSTERING), "min_score": MIN_SCORE},
    training=TRAINING,
    protocol=PROTOCOL,
    models=choose_models,
    illustrate=make_picture_sections,
)
SHIPPED = replace(
    EG_POINTPILLARS,
    name="eg-pointpillars-shipped",
    title="EG-PointPillars: the tables of the paper with the shipped weights",
    question="How do the shipped versions of PointPillars compare on the same frames?",
    make_sections=make_shipped_sections,
    settings={
        **EG_POINTPILLARS.settings,
        "weights": {name: sha256(m.weights.read_bytes()).hexdigest()[:12] for name, m in SHIPPED_MODELS.items()},
    },
    training=None,
    protocol={},
    models=None,
).with_models(SHIPPED_MODELS)
