"""`kronc export`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from kronc_ns.errors import KroncError


@dataclass(kw_only=True)
class Export:
    """Write solved poses in another format."""

    data: Path
    """Folder that `kronc solve` or `ns-process-data kronc` wrote."""
    format: Literal["colmap", "ply"]
    """colmap: binary COLMAP model in a folder; ply: camera centres and keypoints as a point cloud."""
    output: Path | None = None
    """Where to (default: DATA/colmap/sparse/0, or DATA/cameras.ply); must not exist."""

    def run(self) -> int:
        """Export."""
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
