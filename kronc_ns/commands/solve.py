"""`kronc solve`."""

from dataclasses import dataclass
from pathlib import Path

from kronc_ns.commands.options import SolverOptions
from kronc_ns.errors import KroncError


@dataclass(kw_only=True)
class Solve(SolverOptions):
    """Find the camera poses of scene folders (transforms.json with intrinsics, keypoints.json)."""

    data: tuple[Path, ...]
    """Scene folder; several (or a quoted pattern such as 'captures/*') are solved together."""
    output_dir: Path
    """New or empty folder, or one with an earlier result; gets transforms.json, kronc.json and keypoints.ply. Of
    several scenes each gets a folder of its name in it."""
    keypoints: Path | None = None
    """Keypoints from elsewhere (of a single scene): our keypoints.json, COCO, OpenPifPaf, MMPose, Ultralytics or Label
    Studio (docs/keypoints.md)."""
    keypoint_names: str | None = None
    """Which points they are, where their file does not say: apollocar3d-66, openpifpaf-24, or a file with a name a
    line."""
    depth_weights: Path | None = None
    """For --depth-init prior without depth maps: folder or Hugging Face name of a DINOv2 model with a DPT head (default
    facebook/dpt-dinov2-base-kitti, downloaded)."""

    def run(self) -> int:
        """Solve and write."""
        from rich.console import Console

        from kronc_ns.capture.depth import with_depths
        from kronc_ns.commands.batch import expand, solve_folders
        from kronc_ns.commands.console import exit_status, progress_bar, report_table, solving
        from kronc_ns.files.cache import fingerprint
        from kronc_ns.files.output import claim_output
        from kronc_ns.files.record import write_solution
        from kronc_ns.files.scene_folder import load_scene
        from kronc_ns.fit.pipeline import solve_scene

        config = self.solver_config()
        folders = expand(self.data)
        if len(folders) > 1:
            for option, value in (("keypoints", self.keypoints), ("keypoint-names", self.keypoint_names)):
                if value is not None:
                    raise KroncError(f"--{option} {value} with {len(folders)} scenes: expected a single scene")
            return solve_folders(folders, self.output_dir, config, self.depth_weights)
        scene = load_scene(folders[0], self.keypoints, self.keypoint_names)
        if self.output_dir.resolve() == folders[0].resolve():
            raise KroncError(f"--output-dir {self.output_dir} is the scene itself: choose another folder")
        with progress_bar("estimating depths") as progress:
            scene = with_depths(scene, folders[0], config, self.depth_weights, progress)
        claim_output(self.output_dir)
        with solving() as progress:
            solution = solve_scene(scene, config, progress)
        report = write_solution(self.output_dir, scene, solution, folders[0], fingerprint(scene, config))
        Console().print(report_table(report, scene.notes))
        print(f"{self.output_dir / 'transforms.json'}")
        return exit_status(report)
