"""Question 2: does CPA do more than a stronger dilation would?"""

from lidar_perception.candidates.configurations import PAPER
from lidar_perception.param_fields import with_values
from lidar_perception.reproduction.variants import compared_variants

CPA = PAPER.cpa.steps


def _with(steps: int, dilations: int):
    return with_values(PAPER, {"cpa.steps": steps, "stm.dilations": dilations})


STUDY = compared_variants(
    "morphology", "CPA against morphology",
    "What do CPA, a stronger dilation and both add to plain template matching?",
    {"none": _with(0, 1), "CPA (the paper)": _with(CPA, 1), "dilated twice": _with(0, 2),
     "dilated 3 times": _with(0, 3), "dilated 4 times": _with(0, 4),
     "CPA, dilated twice": _with(CPA, 2), "CPA, dilated 3 times": _with(CPA, 3)})
