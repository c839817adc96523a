#!/usr/bin/env python
"""The picture of the README: cameras before and after, reprojected keypoints, trained views.

`python scripts/readme_picture.py QUICKSTART_FOLDER docs/quickstart.png`, with a folder scripts/quickstart made.
"""

from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from PIL import Image

from kronc_ns.files.record import read_solution
from kronc_ns.files.scene_folder import load_scene
from kronc_ns.files.transforms import read_poses
from kronc_ns.fit.starts import circular_poses
from kronc_ns.geometry.alignment import umeyama
from kronc_ns.geometry.camera import reproject
from kronc_ns.keypoints.schema import APOLLOCAR3D_66

BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#888888"  # told apart by colour-blind people


@dataclass
class Options:
    """What to draw and where to."""

    quickstart: tyro.conf.Positional[Path]
    output: tyro.conf.Positional[Path]
    view: int = 13
    """View to draw the reprojections in."""


def main(options: Options) -> None:
    """Draw."""
    data = options.quickstart / "processed"
    scene = load_scene(data)
    poses, reference = read_poses(data / "transforms.json"), read_poses(data / "reference.json")
    names = [name for name in scene.names if name in poses]
    solved, truth = (np.stack([source[name] for name in names]) for source in (poses, reference))
    points = read_solution(data)[1].points
    to_truth = umeyama(solved[..., 3], truth[..., 3])
    circle = circular_poses(len(names), radius_m=5.0)
    start = umeyama(circle[..., 3], truth[..., 3]).rotation @ circle[..., 3:]

    figure = plt.figure(figsize=(12, 6.6), layout="constrained")
    grid = figure.add_gridspec(2, 3, width_ratios=[1.25, 1, 1])
    top = figure.add_subplot(grid[:, 0])
    world = to_truth.apply(points)
    for edge in APOLLOCAR3D_66.skeleton:
        top.plot(*world[list(edge), :2].T, color=GREY, lw=0.8)
    top.scatter(*world[:, :2].T, s=6, color="black", label="solved keypoints")
    top.scatter(*start[:, :2, 0].T, s=16, marker="x", color=ORANGE, label="start: circle")
    top.scatter(*truth[:, :2, 3].T, s=50, facecolors="none", edgecolors=GREY, label="true cameras")
    aligned = to_truth.apply_to_poses(solved)
    top.quiver(*aligned[:, :2, 3].T, *aligned[:, :2, 2].T, color=BLUE, scale=22, width=0.004, label="solved cameras")
    top.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="Cameras and keypoints from above")
    top.legend(loc="lower center", bbox_to_anchor=(0.5, -0.28), ncol=2, frameon=False)

    image = np.asarray(Image.open(data / names[options.view]).convert("RGB"))
    axis = figure.add_subplot(grid[0, 1:])
    axis.imshow(image, extent=(0, image.shape[1], image.shape[0], 0))
    uv = reproject(points, solved[options.view : options.view + 1], scene.camera)[0]
    seen = scene.visibility[scene.names.index(names[options.view])] > 0
    detected = scene.keypoints[scene.names.index(names[options.view])]
    axis.scatter(*detected[seen, :2].T, s=45, facecolors="none", edgecolors="white", linewidths=1.3, label="detected")
    axis.scatter(*uv[seen].T, s=9, color=ORANGE, label="solved, projected")
    axis.set(title="Keypoints in one view", xticks=[], yticks=[])
    axis.legend(loc="lower right", fontsize=8)

    renders = sorted((options.quickstart / "renders").glob("*.jpg")) or sorted(
        (options.quickstart / "renders").glob("*.png")
    )
    pairs = [path for path in renders if "img" in path.name][1:3]
    for column, path in enumerate(pairs, start=1):
        axis = figure.add_subplot(grid[1, column])
        axis.imshow(np.asarray(Image.open(path)))
        axis.set(title="Test view: truth | trained", xticks=[], yticks=[])
    options.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.output, dpi=110)


if __name__ == "__main__":
    main(tyro.cli(Options))
