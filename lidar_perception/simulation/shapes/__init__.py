"""Things of a scene as rows of PART (solids.py).

Every thing has its own frame: x forward, y left, z up from the ground below its origin; metres,
radians. Things that KITTI labels are a Thing (thing.py) with the size of their box; all others are
(P,) PART. Reflectances are those that KITTI's sensor reports for such surfaces at normal incidence.
"""
