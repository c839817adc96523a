"""What commands that refine poses by image features share."""

import sys
from pathlib import Path

from kronc_ns.commands.console import progress_bar
from kronc_ns.files.photos import photos
from kronc_ns.refine.options import RefineConfig
from kronc_ns.refine.pipeline import refine_scene
from kronc_ns.scene import Scene
from kronc_ns.solution import Solution
from kronc_ns.solve import elimination


def refine_with_bar(folder: Path, scene: Scene, solution: Solution, config: RefineConfig) -> Solution:
    """`refine_scene` on the photos of ``folder``; ``scene`` is as the solver took it, left and right put right."""
    if not elimination.is_ready():
        print("compiling the refinement for this machine, once (about 30 s)", file=sys.stderr)
    with progress_bar("refining by images") as progress:
        return refine_scene(scene, solution, photos(folder, scene), config, progress)
