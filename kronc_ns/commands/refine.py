"""`kronc refine`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from kronc_ns.commands.options import Flag
from kronc_ns.errors import KroncError


@dataclass(kw_only=True)
class Refine:
    """Refine the poses of a solved folder by features of its images, where held-out features confirm that it helps."""

    data: Path
    """Folder that `kronc solve` or `ns-process-data kronc` wrote."""
    output_dir: Path
    """New or empty folder, or one with an earlier result; gets transforms.json, kronc.json, keypoints.ply and
    features.npz."""
    refine_region: Literal["auto", "vehicle", "frame"] = "auto"
    """Where features may lie. vehicle: inside the masks, or without them around the keypoints; frame: everywhere; auto:
    everywhere, unless the background stands still while the car turns."""
    refine_focal: Flag = False
    """Treat the focal length as unknown, too."""
    refine_k1: Flag = False
    """Treat the first radial distortion coefficient as unknown, too."""
    seed: int = 0
    """Seed of the choice of tracks that are held out."""

    def run(self) -> int:
        """Refine and write; the status is that of the solution, whichever poses it has in the end."""
        import sys
        from dataclasses import replace

        import numpy as np
        from rich.console import Console

        from kronc_ns.commands.console import exit_status, report_table
        from kronc_ns.commands.refining import refine_with_bar
        from kronc_ns.files.output import check_output, claim_output
        from kronc_ns.files.record import read_record, read_solution, write_solution
        from kronc_ns.files.scene_folder import masks_of
        from kronc_ns.refine.options import RefineConfig

        if self.output_dir.resolve() == self.data.resolve():
            raise KroncError(f"--output-dir {self.output_dir} is --data itself: choose another folder")
        check_output(self.output_dir)
        scene, solution = read_solution(self.data)
        scene = replace(scene, masks=masks_of(self.data, scene.names))
        # reports name the images as the scene does that is refined, which need not be the one that was solved
        views = tuple(replace(view, name=name) for view, name in zip(solution.views, scene.names, strict=True))
        solution = replace(solution, views=views)
        config = RefineConfig(self.refine_region, self.refine_focal, self.refine_k1, self.seed)
        refined = refine_with_bar(self.data, scene, solution, config)
        claim_output(self.output_dir)
        inputs = str(read_record(self.data).get("inputs", ""))
        detected = scene.with_sides_swapped(np.array([view.swapped for view in views]))
        report = write_solution(self.output_dir, detected, refined, self.data, inputs)
        Console().print(report_table(report))
        print(f"{self.output_dir / 'transforms.json'}")
        if refined.images is not None and not refined.images.accepted:
            print(f"the poses stay as they were: {refined.images.reason}", file=sys.stderr)
        return exit_status(report)
