"""Shapes of the objects of a scene, as rows of PART (solids.py).

Each object has its own frame: x forward, y left, z up from the ground below its origin; metres,
radians. Labelled objects are a SceneObject; all others are arrays (P,) PART. Reflectances are those
that KITTI's sensor reports for such surfaces at normal incidence.
"""
