"""The picture of simulate.md: scenes for robots, as a fine sensor and as a VLP-16 sees them:
python docs/robot_scenes.py"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from lidar_perception.geometry import box_corners
from lidar_perception.simulation.drive import simulate_scan
from lidar_perception.simulation.raycast import Hits, cast_rays
from lidar_perception.simulation.scene import Scenes, make_scene
from lidar_perception.simulation.sensor import find_sensor, make_generic_sensor

SHOWN = (("campus", "forecourt", 2), ("indoor", "hall", 12))  # scene, kind, seed
MOMENT, HEIGHT = 50, 0.6
GROUND = (40, 44, 48, 72)  # of SemanticKITTI
FINE = make_generic_sensor(120, -30.0, 30.0, 0.25, 10.0, height=HEIGHT, divergence=0.0)


def main() -> None:
    """Draw docs/images/robot_scenes.png."""
    figure, axes = plt.subplots(
        2 * len(SHOWN), 1, figsize=(12, 13), layout="constrained", height_ratios=[1, 2.2] * len(SHOWN)
    )
    for (scene, kind, seed), view, above in zip(SHOWN, axes[::2], axes[1::2]):
        made = make_scene(seed, kind, 1.0, scene)
        moment = made.compute_state(MOMENT / FINE.rate, HEIGHT)
        draw_view(
            view, cast_rays(moment.solids, made.ground, moment.position, FINE, moment.motion, heading=moment.heading)
        )
        scan = simulate_scan(seed, MOMENT, find_sensor("vlp-16", HEIGHT), Scenes(kind, 1.0, scene))
        ground = np.isin(scan.semantic, GROUND)
        for mask, size, colour in ((ground, 0.3, "0.7"), (~ground, 0.8, "tab:brown")):
            above.scatter(*scan.frame.xyz[mask, :2].T, s=size, c=colour, linewidths=0)
        for corners in box_corners(moment.boxes)[:, [0, 1, 2, 3, 0], :2]:
            above.plot(*corners.T, color="tab:red", linewidth=1)
        above.set(xlim=(-30, 30), ylim=(-12, 12), aspect="equal", title=f"{scene}: {kind}")
    figure.savefig(Path(__file__).parent / "images/robot_scenes.png", dpi=75)


def draw_view(axes: Axes, hits: Hits) -> None:
    """All around, from behind over the left, ahead (the middle) and the right; labelled things
    red."""

    def picture(grid: np.ndarray) -> np.ndarray:
        return np.roll(grid[::-1], len(grid) // 2, axis=0).T

    far, shade, owner = picture(hits.range), picture(hits.cosine), picture(hits.owner)
    with np.errstate(invalid="ignore"):
        image = plt.get_cmap("turbo")(np.clip(np.log(far / 0.8) / np.log(60), 0, 1))[..., :3]
    image *= 0.35 + 0.65 * shade[..., None]
    image[owner > 0] = np.outer(0.3 + 0.7 * shade[owner > 0], [0.9, 0.2, 0.2])
    image[~np.isfinite(far)] = 1.0
    axes.imshow(image, aspect=1.2)
    axes.axis("off")


if __name__ == "__main__":
    main()
