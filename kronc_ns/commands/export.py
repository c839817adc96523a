"""`kronc export`."""

import sys
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from kronc_ns.errors import KroncError


@dataclass(kw_only=True)
class Export:
    """Write solved poses in another format (--data), or those that a training refined (--run)."""

    data: Path | None = None
    """Folder that `kronc solve` or `ns-process-data kronc` wrote."""
    trained: Annotated[Path | None, tyro.conf.arg(name="run")] = None
    """config.yml of a trained run of any nerfstudio method that refined poses (barf, l2g-nerf, a camera optimizer)."""
    format: Literal["colmap", "ply", "transforms"]
    """colmap: binary COLMAP model in a folder; ply: camera centres and keypoints as a point cloud; transforms (of a
    run): the training views' transforms.json, in the world of the poses that training began at."""
    output: Path | None = None
    """Where to (default: DATA/colmap/sparse/0, DATA/cameras.ply, or refined/transforms.json beside the config.yml);
    must not exist."""

    def run(self) -> int:
        """Export."""
        if (self.format == "transforms") != (self.trained is not None) or (self.data is None) == (self.trained is None):
            raise KroncError("expected --run with --format transforms, or --data with --format colmap or ply")
        if self.trained is not None:
            return _export_refined(self.trained, self.output or self.trained.parent / "refined" / "transforms.json")
        assert self.data is not None
        if not (self.data / "kronc.json").exists():
            raise KroncError(f"{self.data / 'kronc.json'} does not exist: expected a folder solved by `kronc solve`")
        default = self.data / ("colmap/sparse/0" if self.format == "colmap" else "cameras.ply")
        output = self.output or default
        if output.is_file() or (output.is_dir() and any(output.iterdir())):
            raise KroncError(f"{output} exists already: give another --output")
        if self.format == "colmap":
            from kronc_ns.files.colmap import write_colmap

            print(f"{write_colmap(output, self.data)} images: {output}")
        else:
            print(f"{write_ply(output, self.data)} points: {output}")
        return 0


def _export_refined(config: Path, output: Path) -> int:
    """Write the poses that a run refined."""
    if output.exists():
        raise KroncError(f"{output} exists already: give another --output")
    with redirect_stdout(sys.stderr):  # of nerfstudio, which prints while it loads
        from kronc_ns.plugin.refined import write_refined_poses

        count = write_refined_poses(config, output)
    print(f"{count} training views: {output}")
    return 0


def write_ply(path: Path, solved: Path) -> int:
    """Write camera centres (blue) and keypoints (red) of a solved folder as a point cloud; returns their number."""
    import numpy as np

    from kronc_ns.files.ply import write_points
    from kronc_ns.files.record import KEYPOINT_COLOUR, solved_points
    from kronc_ns.files.transforms import read_poses

    poses = read_poses(solved / "transforms.json")
    points = solved_points(solved)
    if not poses:
        raise KroncError(f"{solved / 'transforms.json'}: no view has a pose, there is nothing to export")
    centres = np.stack(list(poses.values()))[..., 3]
    blue = np.array([40, 80, 200], dtype=np.uint8)
    colours = np.concatenate([np.tile(blue, (len(centres), 1)), np.tile(KEYPOINT_COLOUR, (len(points), 1))])
    write_points(path, np.concatenate([centres, points]), colours)
    return len(colours)
