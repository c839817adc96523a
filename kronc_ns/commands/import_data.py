"""`kronc import`."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(kw_only=True)
class Import:
    """Make a scene folder from a CarPatch scene, or from images with keypoints and a COLMAP model (KRONC-dataset)."""

    data: Path
    """CarPatch: transforms_SPLIT.json as of NeRF-synthetic, images, and keypoints_SPLIT.json or SPLIT/keypoints.json.
    Else: images/ or frames/, COLMAP's sparse/0, keypoints.json or keypoints/, and optionally masks/."""
    output_dir: Path
    """New or empty folder for the scene; the poses that came along go to reference.json."""
    splits: tuple[str, ...] = ("train", "test")
    """Splits of CarPatch to take, one after the other."""

    def run(self) -> int:
        """Write the scene folder."""
        from kronc_ns.capture.datasets import import_dataset

        views = import_dataset(self.data, self.output_dir, self.splits)
        print(f"{views} views: {self.output_dir}")
        return 0
